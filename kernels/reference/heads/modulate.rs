//! Modulation by another token (adaptive layer norm).

/// Returns `x + gate * (norm(x) * (1 + scale) + shift)` for `modulation [rows, 3 width]`: shift,
/// scale and gate.
pub fn modulate(x: &[f64], modulation: &[f64], width: usize, eps: f64) -> Vec<f64> {
    let plain = crate::ops::layer_norm::layer_norm(x, &vec![1.0; width], &vec![0.0; width], eps);
    let value = |i: usize| {
        let part = |part: usize| modulation[i / width * 3 * width + part * width + i % width];
        x[i] + part(2) * (plain[i] * (1.0 + part(1)) + part(0))
    };
    (0..x.len()).map(value).collect()
}
