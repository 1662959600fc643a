//! Layer normalisation.

use super::{
    Area, Case, Mode, Worst,
    bound::{DIVISION, ROOT, TINY, U, gamma},
    trial::Trial,
};
use crate::noise::Noise;
use zipsplat::{
    Result,
    gpu::Device,
    ops::{Norm, NormRows},
};
use zipsplat_reference::{ops::layer_norm::layer_norm, widen};

const REASON: &str = "the mean is off by d <= gamma mean|x|, of which the second pass takes back all but gamma mean|x - mean|; \
    the variance then by gamma (variance + d^2), relative to variance + epsilon (corrected two-pass algorithm: Chan, Golub \
    and LeVeque 1983); plus Vulkan's limits for root and division";

const EPS: f32 = 1e-6;

/// Bounds of the errors of a normalised row, before its weight and bias, which are exact.
pub fn normed_errors(row: &[f64], eps: f64) -> Vec<f64> {
    let n = row.len() as f64;
    let mean_of = |f: &dyn Fn(f64) -> f64| row.iter().map(|&x| f(x)).sum::<f64>() / n;
    // Sums of n terms and a division, which counts as five roundings.
    let sum = gamma(row.len() + 6);
    let mean = mean_of(&|x| x);
    let variance = mean_of(&|x| (x - mean).powi(2));
    let first = sum * mean_of(&f64::abs) + 2.0 * TINY;
    let spread = mean_of(&|x| (x - mean).abs()) + first;
    let second = sum * spread + 2.0 * TINY;
    let variance_error = gamma(row.len() + 10) * (variance + first * first) + 2.0 * (first + second) * second + TINY;
    let scale = |variance: f64| 1.0 / (variance.max(0.0) + eps).sqrt();
    let own = ROOT + DIVISION + U;
    let [lowest, highest] = [variance + variance_error, variance - variance_error].map(scale);
    let (exact, highest) = (scale(variance), highest * (1.0 + own));
    let scale_error = (exact - lowest * (1.0 - own)).max(highest - exact);
    let error = |&x: &f64| {
        let d = (x - mean).abs();
        let d_error = 2.0 * U * (d + first) + second;
        d_error * highest + d * scale_error + 2.0 * U * (d + d_error) * highest + TINY * (1.0 + highest)
    };
    row.iter().map(error).collect()
}

/// Bounds of the errors of `normed * weight + bias`.
pub fn affine_errors(errors: &[f64], truth: &[f64], weight: &[f32], bias: &[f32]) -> Vec<f64> {
    let columns = weight.iter().zip(bias).map(|(&w, &b)| (f64::from(w.abs()), f64::from(b.abs())));
    let error = |(i, (w, b)): (usize, (f64, f64))| {
        let carried = w * errors[i];
        carried + 2.0 * U * (truth[i].abs() + b + carried) + TINY
    };
    columns.enumerate().map(error).collect()
}

fn check(device: &Device, width: usize, x: &[f32]) -> Result<Worst> {
    let mut noise = Noise(width as u64);
    let (weight, bias) = (noise.values(width), noise.values(width));
    let mut trial = Trial::new(device);
    let norm = Norm { weight: trial.input(&weight), bias: trial.input(&bias), width, eps: EPS };
    let (input, out) = (trial.input(x), trial.output::<f32>(x.len()));
    norm.record(&mut trial.rec, input, None, out, NormRows::packed(x.len() / width, width));
    let got: Vec<f32> = trial.result(out)?;
    let (x, eps) = (widen(x), f64::from(EPS));
    let truth = layer_norm(&x, &weight, &bias, eps);
    let rows = x.chunks(width).zip(truth.chunks(width));
    let bounds: Vec<f64> =
        rows.flat_map(|(row, truth)| affine_errors(&normed_errors(row, eps), truth, &weight, &bias)).collect();
    Ok(Worst::of(&got, &truth, |i| bounds[i]))
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: String, width: usize, value: fn(f32, usize) -> f32| {
        cases.push(Case::new(name, width, move |device, _| {
            let x: Vec<f32> =
                Noise(5).values(9 * width).into_iter().enumerate().map(|(i, r)| value(r, i % width)).collect();
            check(device, width, &x)
        }));
    };
    for width in [1, 3, 64, 384, 1536, 4096] {
        add("random".into(), width, |r, _| r);
        add("mean 1e4, spread 1e-2".into(), width, |r, _| 1e4 + 1e-2 * r);
    }
    add("constant rows of 0".into(), 64, |_, _| 0.0);
    add("constant rows of -3".into(), 64, |_, _| -3.0);
    add("constant rows of 12345.678".into(), 1536, |_, _| 12_345.678);
    add("variance of epsilon".into(), 384, |r, _| 2e-3 * r);
    add("one channel of 1e4".into(), 1536, |r, c| if c == 77 { 1e4 } else { r });
    add("first channel of 1e6".into(), 384, |r, c| if c == 0 { 1e6 } else { r });
    add("values of 1e4".into(), 1536, |r, _| 1e4 * r);
    add("values of 1e15".into(), 64, |r, _| 1e15 * r);
    add("subnormal rows".into(), 64, |r, _| 1e-39 * r);
    Area { kernel: "ops/layer_norm", size: "channels", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
