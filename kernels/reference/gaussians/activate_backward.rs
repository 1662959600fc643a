use crate::ops::activation::{sigmoid, softplus};

/// Returns `d loss / d raw` for gradient `d` by [`activate`](super::activate::activate)'s output.
pub fn activate_backward(raw: &[f64], d: &[f64]) -> Vec<f64> {
    let mean = |i: usize| if raw[i].abs() <= 5.0 { d[i] * raw[i].abs().exp() } else { 0.0 };
    let scale = |i: usize| match softplus(raw[i] - 4.0) {
        scale if (1e-6..=15.0).contains(&scale) => d[i] * sigmoid(raw[i] - 4.0),
        _ => 0.0,
    };
    // The Jacobian of q / |q| is (1 - q q^T / |q|^2) / |q|.
    let length2 = raw[6..10].iter().map(|x| x * x).sum::<f64>();
    let quat = |i: usize| {
        let identity = |j: usize| if i == j { 1.0 } else { 0.0 };
        let row = (6..10).map(|j| d[j] * (identity(j) - raw[i] * raw[j] / length2));
        if length2.sqrt() < 1e-12 { d[i] / 1e-12 } else { row.sum::<f64>() / length2.sqrt() }
    };
    let opacity = d[10] * sigmoid(raw[10]) * sigmoid(-raw[10]);
    let geometry = (0..3).map(mean).chain((3..6).map(scale)).chain((6..10).map(quat));
    geometry.chain([opacity]).chain(d[11..].iter().copied()).collect()
}
