//! Scalar functions of the network.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// The error function to about 1e-15, by `2/sqrt(pi) e^(-x^2) sum 2^n x^(2n+1) / (2n+1)!!`, whose terms all have one sign
/// (Abramowitz and Stegun 7.1.6).
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

/// GELU, the exact one: `x Phi(x)`.
pub fn gelu(x: f64) -> f64 {
    0.5 * x * (1.0 + erf(x * FRAC_1_SQRT_2))
}

/// The logistic function.
pub fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// SiLU: `x sigmoid(x)`.
pub fn silu(x: f64) -> f64 {
    x * sigmoid(x)
}

/// `ln(1 + e^x)`; x itself above 20, as torch does (apart by 2e-9 there).
pub fn softplus(x: f64) -> f64 {
    if x > 20.0 { x } else { x.exp().ln_1p() }
}

/// Rows `[gate | value]` of width `2 hidden` to rows `silu(gate) * value` of width `hidden`.
pub fn swiglu(x: &[f64], hidden: usize) -> Vec<f64> {
    x.chunks(2 * hidden).flat_map(|row| (0..hidden).map(|j| silu(row[j]) * row[hidden + j])).collect()
}
