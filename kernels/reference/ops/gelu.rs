use super::activation::erf;
use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// Returns `d loss / dx` for `gradient = d loss / d gelu(x)`.
pub fn gelu_backward(x: f64, gradient: f64) -> f64 {
    let density = (-x * x / 2.0).exp() / (2.0 * PI).sqrt();
    gradient * (0.5 * (1.0 + erf(x * FRAC_1_SQRT_2)) + x * density)
}
