/// Normalizes rows to mean 0 and biased variance 1, then applies `weight` and `bias`.
pub fn layer_norm(x: &[f64], weight: &[f32], bias: &[f32], eps: f64) -> Vec<f64> {
    let width = weight.len();
    let normed = x.chunks(width).flat_map(|row| {
        let mean = row.iter().sum::<f64>() / width as f64;
        let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / width as f64;
        (0..width).map(move |j| (row[j] - mean) / (variance + eps).sqrt() * f64::from(weight[j]) + f64::from(bias[j]))
    });
    normed.collect()
}
