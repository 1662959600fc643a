/// Returns values in 127ths of their row's largest magnitude, and the rows' units, 0 if all are 0.
pub fn quantize_rows(source: &[f64], width: usize) -> (Vec<f64>, Vec<f64>) {
    let units: Vec<f64> =
        source.chunks(width).map(|row| row.iter().fold(0.0, |most: f64, x| most.max(x.abs())) / 127.0).collect();
    let in_units = |(i, x): (usize, &f64)| if units[i / width] > 0.0 { x / units[i / width] } else { 0.0 };
    (source.iter().enumerate().map(in_units).collect(), units)
}
