//! The Gaussian head.

use crate::reference::backbone::block::mlp;
use crate::reference::model::Scope;
use crate::reference::ops::activation::{sigmoid, softplus};

/// Scene tokens `[n, width]` and colour tokens `[n, colour_width]` to raw Gaussians `[n, G * (11 + 3K)]`.
pub fn head(weights: &Scope, scene: &[f64], width: usize, colour: &[f64], colour_width: usize) -> Vec<f64> {
    let rows = scene.chunks(width).zip(colour.chunks(colour_width));
    let joined: Vec<f64> = rows.flat_map(|(scene, colour)| scene.iter().chain(colour)).copied().collect();
    weights.linear("1", &mlp(&weights.scope("0"), &joined))
}

/// One raw Gaussian to world units: means 3, scales 3 (sigma), quat 4 (wxyz, unit), opacity 1, SH as it is.
pub fn activate(raw: &[f64]) -> Vec<f64> {
    let mean = |x: f64| {
        let x = x.clamp(-5.0, 5.0);
        x.signum() * x.abs().exp_m1()
    };
    let scale = |x: f64| softplus(x - 4.0).clamp(1e-6, 15.0);
    let length = raw[6..10].iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-12);
    let means = raw[..3].iter().map(|&x| mean(x));
    let scales = raw[3..6].iter().map(|&x| scale(x));
    let quat = raw[6..10].iter().map(|x| x / length);
    means.chain(scales).chain(quat).chain([sigmoid(raw[10])]).chain(raw[11..].iter().copied()).collect()
}
