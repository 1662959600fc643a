//! Gradients by central differences; blending, which has thresholds, is differentiated by hand.

use super::{
    project::{Camera, Gaussians, MIN_ALPHA, project},
    rasterize::{MAX_ALPHA, MIN_TRANSMITTANCE, render},
    sh,
};
use glam::{DMat3, DVec3};

/// Weights of outputs, whose sum is the loss.
#[derive(Clone, Debug, Default)]
pub struct Weights {
    /// `[images, H, W, 3]`.
    pub rgb: Vec<f64>,
    /// `[images, H, W]`.
    pub alpha: Vec<f64>,
    /// `[images, H, W]`.
    pub depth: Vec<f64>,
}

#[derive(Clone, Debug)]
pub struct Direction {
    pub gaussians: Gaussians,
    /// w and v of the camera-to-world pose o (exp(w^), v); fx, fy, cx, cy.
    pub cameras: Vec<[f64; 10]>,
}

impl Direction {
    pub fn still(gaussians: &Gaussians, cameras: usize) -> Self {
        let count = gaussians.means.len();
        let gaussians = Gaussians {
            means: vec![[0.0; 3]; count],
            quats: vec![[0.0; 4]; count],
            scales: vec![[0.0; 3]; count],
            opacities: vec![0.0; count],
            sh_coeffs: vec![0.0; gaussians.sh_coeffs.len()],
        };
        Self { gaussians, cameras: vec![[0.0; 10]; cameras] }
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Drawing {
    pub antialiased: bool,
    pub expected_depth: bool,
    pub background: [f64; 3],
}

/// Differentiates the weighted sum along a direction.
pub fn along(
    gaussians: &Gaussians,
    cameras: &[Camera],
    drawing: Drawing,
    weights: &Weights,
    direction: &Direction,
    step: f64,
) -> f64 {
    let loss = |by: f64| {
        let moved = moved_gaussians(gaussians, &direction.gaussians, by);
        let cameras = cameras.iter().zip(&direction.cameras).map(|(camera, d)| moved_camera(camera, d, by));
        let pictures = cameras.map(|camera| render(&moved, &camera, drawing.antialiased, drawing.background));
        let mut sums = [0.0; 3];
        for (i, picture) in pictures.enumerate() {
            let pixels = picture.alpha.len();
            let depth = if drawing.expected_depth { &picture.expected_depth } else { &picture.depth };
            sums[0] += dot(&picture.rgb, &weights.rgb[3 * i * pixels..]);
            sums[1] += dot(&picture.alpha, &weights.alpha[i * pixels..]);
            sums[2] += dot(depth, &weights.depth[i * pixels..]);
        }
        sums.iter().sum::<f64>()
    };
    (loss(step) - loss(-step)) / (2.0 * step)
}

fn dot(values: &[f64], weights: &[f64]) -> f64 {
    values.iter().zip(weights).map(|(value, weight)| value * weight).sum()
}

fn moved_gaussians(gaussians: &Gaussians, direction: &Gaussians, by: f64) -> Gaussians {
    fn moved<const N: usize>(values: &[[f64; N]], direction: &[[f64; N]], by: f64) -> Vec<[f64; N]> {
        let each = |(value, d): (&[f64; N], &[f64; N])| std::array::from_fn(|i| value[i] + by * d[i]);
        values.iter().zip(direction).map(each).collect()
    }
    let numbers = |values: &[f64], d: &[f64]| values.iter().zip(d).map(|(value, d)| value + by * d).collect();
    Gaussians {
        means: moved(&gaussians.means, &direction.means, by),
        quats: moved(&gaussians.quats, &direction.quats, by),
        scales: moved(&gaussians.scales, &direction.scales, by),
        opacities: numbers(&gaussians.opacities, &direction.opacities),
        sh_coeffs: numbers(&gaussians.sh_coeffs, &direction.sh_coeffs),
    }
}

fn moved_camera(camera: &Camera, direction: &[f64; 10], by: f64) -> Camera {
    let d = direction.map(|d| by * d);
    let back =
        DMat3::from_cols(DVec3::new(1.0, -d[2], d[1]), DVec3::new(d[2], 1.0, -d[0]), DVec3::new(-d[1], d[0], 1.0));
    // exp(-w^) to first order.
    Camera {
        rotation: back * camera.rotation,
        translation: back * (camera.translation - DVec3::new(d[3], d[4], d[5])),
        intrinsics: std::array::from_fn(|i| camera.intrinsics[i] + d[6 + i]),
        size: camera.size,
    }
}

/// A splat as in render/rasterize_backward: conic A (dx - k dy)^2 + P dy^2.
#[derive(Clone, Copy, Debug)]
pub struct Ellipse {
    /// x of center or ridge, y of center.
    pub place: [f64; 2],
    /// Row where the ridge has the x of `place`.
    pub ridge: f64,
    /// A, k, P.
    pub conic: [f64; 3],
    /// Peak alpha.
    pub opacity: f64,
    pub color: [f64; 3],
    /// Camera z.
    pub depth: f64,
}

/// Computes gradients of splats through one pixel, nearest first, for gradients `d` by RGB, alpha
/// and depth. Per splat: g (1, e, y, e e, e y, y y), RGB and depth, where g is the gradient of ln
/// alpha, e = dx - k dy and y = dy.
pub fn through_pixel(splats: &[Ellipse], [x, y]: [f64; 2], d: [f64; 5], background: [f64; 3]) -> Vec<[f64; 10]> {
    let mut left = 1.0;
    let mut seen = Vec::new();
    for (n, splat) in splats.iter().enumerate() {
        let dy = y - splat.place[1];
        let e = x - splat.place[0] - splat.conic[1] * (y - splat.ridge);
        let full = splat.opacity * (-0.5 * (splat.conic[0] * e * e + splat.conic[2] * dy * dy)).exp();
        let alpha = full.min(MAX_ALPHA);
        if alpha < MIN_ALPHA {
            continue;
        }
        if left * (1.0 - alpha) <= MIN_TRANSMITTANCE {
            break;
        }
        let value = (0..3).map(|c| d[c] * splat.color[c]).sum::<f64>() + d[3] + d[4] * splat.depth;
        seen.push((n, alpha, full > MAX_ALPHA, left, value, e, dy));
        left *= 1.0 - alpha;
    }
    let mut gradients = vec![[0.0; 10]; splats.len()];
    let mut behind = left * (0..3).map(|c| d[c] * background[c]).sum::<f64>();
    for (n, alpha, clamped, left, value, e, y) in seen.into_iter().rev() {
        let weight = alpha * left;
        let g = if clamped { 0.0 } else { weight * value - behind * alpha / (1.0 - alpha) };
        gradients[n] = [
            g,
            g * e,
            g * y,
            g * e * e,
            g * e * y,
            g * y * y,
            weight * d[0],
            weight * d[1],
            weight * d[2],
            weight * d[4],
        ];
        behind += weight * value;
    }
    gradients
}

#[derive(Clone, Copy, Debug)]
pub struct OneGradient {
    pub mean: [f64; 3],
    /// Standard deviations.
    pub scale: [f64; 3],
    /// wxyz.
    pub quat: [f64; 4],
    pub opacity: f64,
    /// As [`Direction::cameras`].
    pub camera: [f64; 10],
}

/// Computes gradients of a visible Gaussian and its camera, by fourth-order differences. `pair` has
/// the moments of [`through_pixel`], and the gradients by the world offset through color and by
/// depth.
pub fn of_splat(gaussian: &Gaussians, camera: &Camera, antialiased: bool, pair: &[f64; 10]) -> OneGradient {
    let splat = |gaussian: &Gaussians, camera: &Camera| project(gaussian, camera, antialiased)[0].expect("it is seen");
    let [xx, xy, yy] = splat(gaussian, camera).conic;
    let k = -xy / xx;
    let [g, ge, gy, gee, gey, gyy] = std::array::from_fn(|i| pair[i]);
    let (dx, dy) = (ge + k * gy, gy);
    let moments = [gee + 2.0 * k * gey + k * k * gyy, gey + k * gyy, gyy];
    let center = [xx * dx + xy * dy, xy * dx + yy * dy];
    let loss = |gaussian: &Gaussians, camera: &Camera| {
        let splat = splat(gaussian, camera);
        let offset = DVec3::from(gaussian.means[0]) - camera.center();
        let [xx, xy, yy] = splat.conic;
        g * splat.opacity.ln() + center[0] * splat.mean[0] + center[1] * splat.mean[1]
            - 0.5 * (moments[0] * xx + 2.0 * moments[1] * xy + moments[2] * yy)
            + DVec3::new(pair[6], pair[7], pair[8]).dot(offset)
            + pair[9] * splat.depth
    };
    let of_gaussian = |step: f64, change: &dyn Fn(&mut Gaussians, f64)| {
        let moved = |by: f64| {
            let mut moved = gaussian.clone();
            change(&mut moved, by);
            loss(&moved, camera)
        };
        difference(moved, step)
    };
    let depth = splat(gaussian, camera).depth;
    let length = gaussian.quats[0].iter().map(|q| q * q).sum::<f64>().sqrt();
    // Thin splats depend on squared scales; a step of their own size is too small.
    let thin = 0.05 * depth / camera.intrinsics[0];
    let of_camera = |i: usize| {
        let step = [1e-6, 1e-6 * depth, 1e-4 * camera.intrinsics[0], 1e-3][[0, 0, 0, 1, 1, 1, 2, 2, 3, 3][i]];
        let mut direction = [0.0; 10];
        direction[i] = 1.0;
        difference(|by| loss(gaussian, &moved_camera(camera, &direction, by)), step)
    };
    OneGradient {
        mean: std::array::from_fn(|i| of_gaussian(1e-6 * depth, &|moved, by| moved.means[0][i] += by)),
        scale: std::array::from_fn(|i| {
            of_gaussian(1e-3 * gaussian.scales[0][i].max(thin), &|moved, by| moved.scales[0][i] += by)
        }),
        quat: std::array::from_fn(|i| of_gaussian(1e-6 * length, &|moved, by| moved.quats[0][i] += by)),
        opacity: of_gaussian(1e-4 * gaussian.opacities[0], &|moved, by| moved.opacities[0] += by),
        camera: std::array::from_fn(of_camera),
    }
}

/// Computes gradients by coefficients `[K, 3]` and camera-to-Gaussian offset, for unclamped color.
pub fn of_color(coeffs: &[f64], offset: DVec3, d: [f64; 3]) -> (Vec<f64>, [f64; 3]) {
    let degree = (coeffs.len() / 3).isqrt() as i32 - 1;
    let basis = sh::basis(degree, offset.normalize());
    let of_coeffs = basis.iter().flat_map(|b| d.map(|d| b * d)).collect();
    let loss = |offset: DVec3| {
        let basis = sh::basis(degree, offset.normalize());
        let terms = basis.iter().zip(coeffs.chunks(3)).map(|(b, k)| b * (0..3).map(|c| k[c] * d[c]).sum::<f64>());
        terms.sum::<f64>()
    };
    let along = |axis: usize| difference(|by| loss(offset + DVec3::AXES[axis] * by), 1e-3 * offset.length());
    (of_coeffs, std::array::from_fn(along))
}

/// Derivative at 0, exact up to degree 4.
fn difference(value: impl Fn(f64) -> f64, step: f64) -> f64 {
    let apart = |by: f64| value(by) - value(-by);
    (8.0 * apart(step) - apart(2.0 * step)) / (12.0 * step)
}
