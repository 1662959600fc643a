//! Activations of the Gaussian head.

use super::{
    Area, Case, Mode, Worst,
    bound::{DIVISION, ROOT, TINY, U, exponential, gamma, logarithm},
    trial::Trial,
};
use crate::noise::Noise;
use zipsplat::{Result, gpu::Device, stages::gaussians};
use zipsplat_reference::{
    gaussians::activate::activate,
    ops::activation::{sigmoid, softplus},
    widen,
};

const REASON: &str = "each activation's slope times the rounding of its argument, plus Vulkan's limits for exp (3 + 2|x| units), log \
    (2^-21 near 1) and division; series by their first term left out; clamped values exactly";

/// Values of a raw Gaussian without spherical harmonics beyond band 0.
const WIDTH: usize = 14;

/// Activates `raw [count, WIDTH]`; the same layout.
fn run(device: &Device, raw: &[f32]) -> Result<Vec<f32>> {
    let count = raw.len() / WIDTH;
    let mut trial = Trial::new(device);
    let input = trial.input(raw);
    let scene = gaussians::activate(&mut trial.rec, input, count, 0);
    let fields = [(scene.means, 3), (scene.scales, 3), (scene.quats, 4), (scene.opacities, 1), (scene.sh_coeffs, 3)];
    for (tensor, _) in fields {
        trial.rec.output(tensor);
    }
    let run = trial.run()?;
    let mut columns = Vec::new();
    for (tensor, width) in fields {
        columns.push((run.read::<f32>(tensor)?, width));
    }
    Ok((0..count)
        .flat_map(|i| columns.iter().flat_map(move |(v, width)| v[i * width..(i + 1) * width].to_vec()))
        .collect())
}

fn check(device: &Device, raw: &[f32]) -> Result<Worst> {
    let got = run(device, raw)?;
    let raw = widen(raw);
    let truth: Vec<f64> = raw.chunks(WIDTH).flat_map(activate).collect();
    let length = |i: usize| raw[i / WIDTH * WIDTH + 6..][..4].iter().map(|x| x * x).sum::<f64>().sqrt();
    Ok(Worst::of(&got, &truth, |i| match i % WIDTH {
        0..3 => mean_error(raw[i].abs().min(5.0)),
        3..6 => scale_error(raw[i]) + U * truth[i],
        6..10 => quat_error(truth[i], length(i)),
        10 => opacity_error(raw[i]),
        _ => 0.0,
    }))
}

/// expm1 at `x >= 0`: a series up to 0.35, where its first term left out is x^7 / 5040, exp(x) - 1 above.
fn mean_error(x: f64) -> f64 {
    let series = x.powi(7) / 5040.0 * 1.1 + gamma(14) * x.exp_m1();
    let difference = x.exp() * exponential(x) + U * x.exp_m1();
    TINY + if x < 0.35 { series } else { difference }
}

/// softplus(x - 4) before its clamps.
fn scale_error(x: f64) -> f64 {
    let z = x - 4.0;
    if z > 20.0 {
        return U * z;
    }
    let u = z.exp();
    let carried = sigmoid(z) * (U * z.abs() + exponential(z));
    // Series of 2 atanh(u / (2 + u)): its first term left out is below 1e-8 of it.
    let series = softplus(z) * (1e-8 + DIVISION + gamma(12));
    let direct = U + logarithm(1.0 + u);
    TINY + carried + if u < 0.5 { series } else { direct }
}

/// A component of a quaternion that was divided by its largest component, then by its length.
fn quat_error(component: f64, length: f64) -> f64 {
    // Short quaternions are divided by 1e-12, which enlarges what was flushed.
    let flushed = if length < 2e-12 { TINY * 1e12 } else { TINY };
    component.abs() * (2.0 * DIVISION + ROOT + gamma(6)) + 4.0 * flushed
}

fn opacity_error(x: f64) -> f64 {
    let opacity = sigmoid(x);
    opacity * ((1.0 - opacity) * exponential(x) + U + DIVISION) + TINY
}

/// What is clamped, or saturates, does so to the same bits on every device.
fn clamps(device: &Device) -> Result<Worst> {
    let mut raw = vec![0.0f32; 4 * WIDTH];
    for (row, x) in raw.chunks_mut(WIDTH).zip([5.0, 7.0, 1e30, f32::MAX]) {
        row[..3].fill(x);
        row[3..6].copy_from_slice(&[19.5 + x, 1e30, f32::MAX]);
        row[6] = 1.0;
        row[10] = 100.0 + x;
    }
    let high = run(device, &raw)?;
    raw.iter_mut().for_each(|x| *x = -*x);
    let low = run(device, &raw)?;
    let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    let mut worst = Worst::NONE;
    for (high, low) in high.chunks(WIDTH).zip(low.chunks(WIDTH)) {
        let first = high[0].abs();
        worst = worst
            .or(Worst::differing(&bits(&high[3..6]), &bits(&[15.0; 3])))
            .or(Worst::differing(&bits(&low[3..6]), &bits(&[1e-6; 3])))
            .or(Worst::differing(&bits(&high[..3]), &bits(&[first; 3])))
            .or(Worst::differing(&bits(&low[..3]), &bits(&[-first; 3])))
            .or(Worst::differing(&bits(&[high[10]]), &bits(&[1.0])));
    }
    let means: Vec<u32> = high.chunks(WIDTH).map(|row| row[0].to_bits()).collect();
    Ok(worst.or(Worst::differing(&means, &vec![means[0]; means.len()])))
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, count: usize, value: fn(usize, f32) -> f32| {
        cases.push(Case::new(name, count, move |device, _| {
            let raw: Vec<f32> =
                Noise(6).values(count * WIDTH).into_iter().enumerate().map(|(i, r)| value(i, r)).collect();
            check(device, &raw)
        }));
    };
    for count in [1, 64, 4097] {
        add("random of +-6", count, |_, r| 6.0 * r);
    }
    add("every value from -100 to 100", 20_001, |i, r| {
        if (6..10).contains(&(i % WIDTH)) { r } else { (i / WIDTH) as f32 / 100.0 - 100.0 }
    });
    add("means near 0, where exp(x) - 1 cancels", 400, |i, _| 0.5f32.powi((i / WIDTH) as i32 / 2));
    for (name, size) in [("0", 0), ("1e-20", 1), ("1e-12", 2), ("1e-6", 3), ("1e20", 4), ("1e37", 5)] {
        let value: fn(usize, f32) -> f32 = match size {
            0 => |i, r| quaternion(i, r, 0.0),
            1 => |i, r| quaternion(i, r, 1e-20),
            2 => |i, r| quaternion(i, r, 1e-12),
            3 => |i, r| quaternion(i, r, 1e-6),
            4 => |i, r| quaternion(i, r, 1e20),
            _ => |i, r| quaternion(i, r, 1e37),
        };
        add(&format!("quaternions of length {name}"), 65, value);
    }
    cases.push(Case::new("clamps and saturation", 4, |device, _| clamps(device)));
    Area { kernel: "gaussians/activate", size: "Gaussians", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}

fn quaternion(i: usize, r: f32, length: f32) -> f32 {
    if (6..10).contains(&(i % WIDTH)) { length * r } else { r }
}
