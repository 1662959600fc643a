/// Returns `rows [N, width]` minus `origin`, and half their squared lengths.
pub fn about(rows: &[f64], origin: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let moved: Vec<f64> =
        rows.chunks(origin.len()).flat_map(|row| row.iter().zip(origin).map(|(x, o)| x - o)).collect();
    let norms = moved.chunks(origin.len()).map(|row| 0.5 * row.iter().map(|x| x * x).sum::<f64>()).collect();
    (moved, norms)
}
