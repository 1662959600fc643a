use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// Computes the error function to about 1e-15 by terms of one sign (Abramowitz and Stegun 7.1.6).
pub fn erf(x: f64) -> f64 {
    if x.abs() > 6.0 {
        return x.signum(); // 1 - erf(6) = 2e-17
    }
    let (mut term, mut sum) = (x, x);
    for n in 1.. {
        term *= 2.0 * x * x / f64::from(2 * n + 1);
        sum += term;
        if term.abs() <= 1e-17 * sum.abs() {
            break;
        }
    }
    2.0 / PI.sqrt() * (-x * x).exp() * sum
}

/// Computes the exact GELU, `x Phi(x)`.
pub fn gelu(x: f64) -> f64 {
    0.5 * x * (1.0 + erf(x * FRAC_1_SQRT_2))
}

pub fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

pub fn silu(x: f64) -> f64 {
    x * sigmoid(x)
}

/// Computes `ln(1 + e^x)`, or `x` above 20, as in PyTorch.
pub fn softplus(x: f64) -> f64 {
    if x > 20.0 { x } else { x.exp().ln_1p() }
}

/// Maps rows `[gate | value]` to `silu(gate) * value`.
pub fn swiglu(x: &[f64], hidden: usize) -> Vec<f64> {
    x.chunks(2 * hidden).flat_map(|row| (0..hidden).map(|j| silu(row[j]) * row[hidden + j])).collect()
}
