/// Averages the halves of `[rows, 2 width]`.
pub fn average_halves(joined: &[f64], width: usize) -> Vec<f64> {
    let rows = joined.chunks(2 * width).map(|row| row.split_at(width));
    rows.flat_map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a + b) / 2.0)).collect()
}
