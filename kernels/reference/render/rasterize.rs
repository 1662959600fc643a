//! Blending: every pixel visits all splats front to back.

use rayon::prelude::*;

use super::project::{Camera, Gaussians, MIN_ALPHA, Splat, project};

pub const MAX_ALPHA: f64 = 0.999;
/// A pixel stops before this transmittance.
pub const MIN_TRANSMITTANCE: f64 = 1e-4;

#[derive(Clone, Copy, Debug)]
pub struct Rules {
    pub min_alpha: f64,
    pub max_alpha: f64,
    pub min_transmittance: f64,
}

impl Default for Rules {
    fn default() -> Self {
        Self { min_alpha: MIN_ALPHA, max_alpha: MAX_ALPHA, min_transmittance: MIN_TRANSMITTANCE }
    }
}

/// Row-major outputs of a camera.
#[derive(Clone, Debug, Default)]
pub struct Rendering {
    /// `[H, W, 3]` over the background.
    pub rgb: Vec<f64>,
    /// `[H, W]`: 1 - transmittance.
    pub alpha: Vec<f64>,
    /// `[H, W]` sum of depth times weight, world units.
    pub depth: Vec<f64>,
    /// `[H, W]` depth over alpha.
    pub expected_depth: Vec<f64>,
    /// `[H, W]` 1 where f32 rounding may decide a threshold.
    pub unstable: Vec<u8>,
}

pub fn render(gaussians: &Gaussians, camera: &Camera, antialiased: bool, background: [f64; 3]) -> Rendering {
    rasterize(&project(gaussians, camera, antialiased), camera.size, background)
}

/// Blends splats by f32 depth, then index.
pub fn rasterize(splats: &[Option<Splat>], size: [usize; 2], background: [f64; 3]) -> Rendering {
    let mut order: Vec<&Splat> = splats.iter().flatten().collect();
    order.sort_by(|a, b| (a.depth as f32).total_cmp(&(b.depth as f32)));
    let [width, height] = size;
    let rules = Rules::default();
    let place = |i: usize| [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5];
    let pixels: Vec<Pixel> =
        (0..width * height).into_par_iter().map(|i| blend(order.iter().copied(), place(i), rules)).collect();
    let behind = |pixel: &Pixel| -> [f64; 3] {
        std::array::from_fn(|channel| pixel.rgb[channel] + pixel.transmittance * background[channel])
    };
    let alpha = |pixel: &Pixel| 1.0 - pixel.transmittance;
    Rendering {
        rgb: pixels.iter().flat_map(behind).collect(),
        alpha: pixels.iter().map(alpha).collect(),
        depth: pixels.iter().map(|pixel| pixel.depth).collect(),
        expected_depth: pixels.iter().map(|pixel| pixel.depth / alpha(pixel).max(1e-10)).collect(),
        unstable: pixels.iter().map(|pixel| u8::from(pixel.unstable)).collect(),
    }
}

pub struct Pixel {
    /// RGB without the background.
    pub rgb: [f64; 3],
    /// Sum of depth times weight.
    pub depth: f64,
    pub transmittance: f64,
    pub unstable: bool,
}

pub fn alpha(splat: &Splat, [x, y]: [f64; 2], rules: Rules) -> f64 {
    let [dx, dy] = [x - splat.mean[0], y - splat.mean[1]];
    let [xx, xy, yy] = splat.conic;
    let sigma = 0.5 * (xx * dx * dx + yy * dy * dy) + xy * dx * dy;
    if sigma < 0.0 { 0.0 } else { (splat.opacity * (-sigma).exp()).min(rules.max_alpha) }
}

/// Blends splats, nearest first, at a pixel's center.
pub fn blend<'a>(splats: impl IntoIterator<Item = &'a Splat>, place: [f64; 2], rules: Rules) -> Pixel {
    let mut pixel = Pixel { rgb: [0.0; 3], depth: 0.0, transmittance: 1.0, unstable: false };
    for splat in splats {
        let alpha = alpha(splat, place, rules);
        pixel.unstable |= (alpha / MIN_ALPHA - 1.0).abs() < 2e-4;
        if alpha < rules.min_alpha {
            continue;
        }
        let transmittance = pixel.transmittance * (1.0 - alpha);
        pixel.unstable |= (transmittance / MIN_TRANSMITTANCE - 1.0).abs() < 2e-3;
        if transmittance <= rules.min_transmittance {
            break;
        }
        let weight = alpha * pixel.transmittance;
        (0..3).for_each(|channel| pixel.rgb[channel] += weight * splat.color[channel]);
        pixel.depth += weight * splat.depth;
        pixel.transmittance = transmittance;
    }
    pixel
}
