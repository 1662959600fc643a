//! Gradients of pictures by central differences of the pictures: no derivative is written down.

use super::{
    project::{Camera, Gaussians},
    rasterise::render,
};
use glam::{DMat3, DVec3};

/// What each output counts in a loss that is their weighted sum, in the pictures' order.
#[derive(Clone, Debug, Default)]
pub struct Weights {
    /// `[pictures, H, W, 3]`.
    pub rgb: Vec<f64>,
    /// `[pictures, H, W]`.
    pub alpha: Vec<f64>,
    /// `[pictures, H, W]`.
    pub depth: Vec<f64>,
}

/// A way to move Gaussians and cameras.
#[derive(Clone, Debug)]
pub struct Direction {
    /// Of each Gaussian.
    pub gaussians: Gaussians,
    /// Of each camera: w and v, where its camera-to-world pose moves as pose o (exp(w^), v); fx, fy, cx, cy.
    pub cameras: Vec<[f64; 10]>,
}

impl Direction {
    /// Moves nothing.
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

/// How pictures are drawn.
#[derive(Clone, Copy, Debug)]
pub struct Drawing {
    /// Whether Gaussians are made fainter by what the blur takes.
    pub antialiased: bool,
    /// Whether depth is the sum over alpha.
    pub expected_depth: bool,
    /// Behind the scene.
    pub background: [f64; 3],
}

/// How much the weighted sum of all outputs changes along a direction, from steps of `step` times it.
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
    // To first order that is exp(-w^).
    Camera {
        rotation: back * camera.rotation,
        translation: back * (camera.translation - DVec3::new(d[3], d[4], d[5])),
        intrinsics: std::array::from_fn(|i| camera.intrinsics[i] + d[6 + i]),
        size: camera.size,
    }
}
