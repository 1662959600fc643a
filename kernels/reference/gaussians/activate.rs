use crate::ops::activation::{sigmoid, softplus};

/// Activates one Gaussian: mean 3, scale 3, quaternion 4 (wxyz, unit), opacity 1, SH.
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
