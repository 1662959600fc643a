use crate::render::backward::{Ellipse, through_pixel};

/// Returns the weight of each splat, nearest first, at a pixel's center.
pub fn weights(splats: &[Ellipse], at: [f64; 2]) -> Vec<f64> {
    // A weight is the gradient by red of a unit gradient.
    through_pixel(splats, at, [1.0, 0.0, 0.0, 0.0, 0.0], [0.0; 3]).iter().map(|gradient| gradient[6]).collect()
}

/// Blends `features`, `[rows, channels]`, of every `group` splats into a pixel.
pub fn draw(weights: &[f64], features: &[f64], channels: usize, group: usize) -> Vec<f64> {
    let mut pixel = vec![0.0; channels];
    for (n, weight) in weights.iter().enumerate() {
        let row = &features[n / group * channels..][..channels];
        pixel.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
    }
    pixel
}

/// Adds a pixel's values, times the weights, to the rows of its splats, and the weights to
/// `totals`. A NaN does not count.
pub fn lift(weights: &[f64], values: &[f64], group: usize, lifted: &mut [f64], totals: &mut [f64]) {
    if values[0].is_nan() {
        return;
    }
    for (n, weight) in weights.iter().enumerate() {
        totals[n / group] += weight;
        let row = &mut lifted[n / group * values.len()..][..values.len()];
        row.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * value);
    }
}
