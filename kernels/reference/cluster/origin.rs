/// Averages `samples` evenly spaced rows of `[N, width]`.
pub fn origin(rows: &[f64], width: usize, samples: usize) -> Vec<f64> {
    let apart = rows.len() / width / samples;
    let sampled: Vec<&[f64]> = rows.chunks(width).step_by(apart).take(samples).collect();
    (0..width).map(|c| sampled.iter().map(|row| row[c]).sum::<f64>() / samples as f64).collect()
}
