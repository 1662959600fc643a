const EPSILON: f64 = 1e-10;

/// Sums weighted squared differences of unit features `[pixels, channels]` per pixel.
pub fn compare(a: &[f64], b: &[f64], weights: &[f32]) -> Vec<f64> {
    let unit = |features: &[f64]| {
        let length = features.iter().map(|x| x * x).sum::<f64>().sqrt() + EPSILON;
        features.iter().map(|x| x / length).collect::<Vec<_>>()
    };
    let pixels = a.chunks(weights.len()).zip(b.chunks(weights.len()));
    let sum = |(a, b): (&[f64], &[f64])| {
        let pairs = unit(a).into_iter().zip(unit(b)).zip(weights);
        pairs.map(|((a, b), weight)| f64::from(*weight) * (a - b).powi(2)).sum()
    };
    pixels.map(sum).collect()
}
