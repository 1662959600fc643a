//! Camera model from linear light to sRGB bytes.

use glam::Vec3A;
use zipsplat::random::mix;

use super::rng::Rng;

/// Linear light where highlights roll off.
const SHOULDER: f32 = 0.65;

/// Equal for all views of a scene.
#[derive(Clone, Debug)]
pub(super) struct Development {
    /// Exposure times white balance.
    pub gain: Vec3A,
    pub blur: f32,
    /// Standard deviation in sRGB, 0..1.
    pub noise: f32,
    pub seed: u64,
}

impl Development {
    /// For a mean scene `luminance`.
    pub fn new(rng: &mut Rng, luminance: f32) -> Self {
        let exposure = rng.scale(0.15, 0.30) / luminance.max(1e-4);
        let warmth = rng.range(-0.1, 0.1);
        let balance = Vec3A::new(1.0 + warmth, 1.0 + rng.range(-0.03, 0.03), 1.0 - warmth);
        let blur = if rng.chance(0.5) { rng.range(0.2, 0.6) } else { 0.0 };
        let noise = if rng.chance(0.6) { rng.range(0.001, 0.012) } else { 0.0 };
        Self { gain: exposure * balance, blur, noise, seed: rng.bits() }
    }

    pub fn develop(&self, view: usize, width: usize, mut linear: Vec<Vec3A>) -> Vec<u8> {
        if self.blur > 0.0 {
            let across = blur(&linear, 1, width, self.blur);
            linear = blur(&across, width, linear.len() / width, self.blur);
        }
        let seed = mix(self.seed.wrapping_add(view as u64));
        let pixel = |(i, light): (usize, &Vec3A)| {
            let srgb =
                linear_to_srgb(soft_clip(*light * self.gain)) + self.noise * gaussian(seed.wrapping_add(i as u64));
            (srgb.clamp(Vec3A::ZERO, Vec3A::ONE) * 255.0 + 0.5).to_array().map(|channel| channel as u8)
        };
        linear.iter().enumerate().flat_map(pixel).collect()
    }

    pub fn brightness(&self, light: Vec3A) -> f32 {
        linear_to_srgb(soft_clip(light * self.gain)).element_sum() / 3.0
    }
}

fn soft_clip(light: Vec3A) -> Vec3A {
    let over = ((light - SHOULDER) / (1.0 - SHOULDER)).max(Vec3A::ZERO);
    light.min(Vec3A::splat(SHOULDER)) + (1.0 - SHOULDER) * over / (1.0 + over)
}

/// Within 0.002, by fast square roots.
pub(super) fn linear_to_srgb(light: Vec3A) -> Vec3A {
    let root = |v: Vec3A| Vec3A::new(v.x.sqrt(), v.y.sqrt(), v.z.sqrt());
    let half = root(light.max(Vec3A::ZERO));
    let quarter = root(half);
    let eighth = root(quarter);
    0.6620 * half + 0.6841 * quarter - 0.3236 * eighth - 0.0225 * light
}

/// Within 0.003, by a cubic.
pub(super) fn srgb_to_linear(srgb: Vec3A) -> Vec3A {
    srgb * (srgb * (srgb * 0.3053 + 0.6822) + 0.0125)
}

/// Three taps along lines of `count` pixels, `step` apart; the border repeats.
fn blur(pixels: &[Vec3A], step: usize, count: usize, sigma: f32) -> Vec<Vec3A> {
    let side = (-0.5 / (sigma * sigma)).exp();
    let (side, middle) = (side / (1.0 + 2.0 * side), 1.0 / (1.0 + 2.0 * side));
    let at = |i: usize| i / step % count;
    let tap = |i: usize| {
        let before = if at(i) > 0 { i - step } else { i };
        let after = if at(i) < count - 1 { i + step } else { i };
        middle * pixels[i] + side * (pixels[before] + pixels[after])
    };
    (0..pixels.len()).map(tap).collect()
}

/// Variance 1: sums of three uniforms per channel.
fn gaussian(counter: u64) -> Vec3A {
    let (a, b) = (mix(counter), mix(!counter));
    let channel = |k: u32| {
        let uniform = |word: u64, shift: u32| ((word >> shift) & 0x3ff) as f32 / 511.5 - 1.0;
        uniform(a, 10 * k) + uniform(b, 10 * k) + uniform(a ^ b.rotate_left(7), 30 + 10 * k)
    };
    Vec3A::new(channel(0), channel(1), channel(2))
}
