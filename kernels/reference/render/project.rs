//! EWA projection of Gaussians (Zwicker et al. 2002).

use glam::{DMat3, DQuat, DVec3};

use super::sh;

/// Added variance, pixels^2.
pub const EPS_2D: f64 = 0.3;
const NEAR: f64 = 0.01;
const FAR: f64 = 1e10;
pub const MIN_ALPHA: f64 = 1.0 / 255.0;
/// Tile side in pixels.
const TILE: f64 = 16.0;

/// Gaussians in world units; their order breaks depth ties.
#[derive(Clone, Debug, Default)]
pub struct Gaussians {
    pub means: Vec<[f64; 3]>,
    /// wxyz, nonzero, any length.
    pub quats: Vec<[f64; 4]>,
    /// Standard deviations.
    pub scales: Vec<[f64; 3]>,
    pub opacities: Vec<f64>,
    /// `[N, K, 3]`.
    pub sh_coeffs: Vec<f64>,
}

/// A pinhole camera, OpenCV axes, pixel centers at +0.5.
#[derive(Clone, Copy, Debug)]
pub struct Camera {
    /// World to camera.
    pub rotation: DMat3,
    /// World to camera.
    pub translation: DVec3,
    /// fx, fy, cx, cy in pixels.
    pub intrinsics: [f64; 4],
    /// Width and height in pixels.
    pub size: [usize; 2],
}

impl Camera {
    /// Converts a world-to-camera matrix `[4, 4]` and intrinsics `[3, 3]`, row-major.
    pub fn new(viewmat: &[f64], k: &[f64], size: [usize; 2]) -> Camera {
        let row = |i: usize| DVec3::from_slice(&viewmat[4 * i..]);
        Camera {
            rotation: DMat3::from_cols(row(0), row(1), row(2)).transpose(),
            translation: DVec3::new(viewmat[3], viewmat[7], viewmat[11]),
            intrinsics: [k[0], k[4], k[2], k[5]],
            size,
        }
    }

    pub fn center(&self) -> DVec3 {
        self.rotation.inverse() * -self.translation
    }
}

#[derive(Clone, Copy, Debug)]
pub struct Splat {
    /// Center in pixels.
    pub mean: [f64; 2],
    /// Camera z.
    pub depth: f64,
    /// Inverse covariance: xx, xy, yy.
    pub conic: [f64; 3],
    /// Peak alpha, compensated if antialiased.
    pub opacity: f64,
    /// `sqrt(det before blur / det after)`.
    pub compensation: f64,
    /// Half extent of the box with alpha >= `MIN_ALPHA`, whole pixels.
    pub radii: [u32; 2],
    /// First and one past the last tile, x and y.
    pub tiles: [[u32; 2]; 2],
    /// RGB, not clamped above.
    pub color: [f64; 3],
}

pub fn project(gaussians: &Gaussians, camera: &Camera, antialiased: bool) -> Vec<Option<Splat>> {
    (0..gaussians.means.len()).map(|i| project_one(gaussians, i, camera, antialiased)).collect()
}

fn project_one(gaussians: &Gaussians, i: usize, camera: &Camera, antialiased: bool) -> Option<Splat> {
    let [fx, fy, cx, cy] = camera.intrinsics;
    let mean = DVec3::from(gaussians.means[i]);
    let p = camera.rotation * mean + camera.translation;
    if !(NEAR..=FAR).contains(&p.z) {
        return None;
    }
    let center = [fx * p.x / p.z + cx, fy * p.y / p.z + cy];
    let [u, v] = spread_2d(gaussians, i, camera, p);
    let blur = EPS_2D.sqrt();
    let [wide_u, wide_v] = [[u[0], u[1], u[2], blur, 0.0], [v[0], v[1], v[2], 0.0, blur]];
    let [xx, xy, yy] = [dot(&wide_u, &wide_u), dot(&wide_u, &wide_v), dot(&wide_v, &wide_v)];
    let determinant = gram_determinant(&wide_u, &wide_v);
    let compensation = (gram_determinant(&u, &v) / determinant).sqrt();
    let opacity = gaussians.opacities[i] * if antialiased { compensation } else { 1.0 };
    if opacity < MIN_ALPHA {
        return None;
    }
    // Standard deviations where opacity exp(-d^2 / 2) falls to MIN_ALPHA.
    let reach = (2.0 * (opacity / MIN_ALPHA).ln()).sqrt().min(3.33);
    let radii = [xx, yy].map(|variance| (reach * variance.sqrt()).ceil());
    let outside =
        |axis: usize| center[axis] + radii[axis] <= 0.0 || center[axis] - radii[axis] >= camera.size[axis] as f64;
    if radii == [0.0, 0.0] || outside(0) || outside(1) {
        return None;
    }
    let coeffs = gaussians.sh_coeffs.len() / gaussians.means.len();
    Some(Splat {
        mean: center,
        depth: p.z,
        conic: [yy / determinant, -xy / determinant, xx / determinant],
        opacity,
        compensation,
        radii: radii.map(|r| r as u32),
        tiles: tiles(center, radii, camera.size),
        color: sh::color(&gaussians.sh_coeffs[i * coeffs..][..coeffs], mean - camera.center()),
    })
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// `|a|^2 |b|^2 - (a b)^2` by two Gram-Schmidt passes: nearly parallel vectors do not cancel.
fn gram_determinant(a: &[f64], b: &[f64]) -> f64 {
    let square = dot(a, a);
    if square == 0.0 {
        return 0.0;
    }
    let mut rest = b.to_vec();
    for _ in 0..2 {
        let along = dot(a, &rest) / square;
        rest.iter_mut().zip(a).for_each(|(rest, a)| *rest -= along * a);
    }
    square * dot(&rest, &rest)
}

/// Vectors whose products are the covariance before blur, linearized at `p` with slopes clamped 15%
/// beyond the image.
fn spread_2d(gaussians: &Gaussians, i: usize, camera: &Camera, p: DVec3) -> [[f64; 3]; 2] {
    let [w, x, y, z] = gaussians.quats[i];
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let spread = camera.rotation * axes * DMat3::from_diagonal(DVec3::from(gaussians.scales[i]));

    let [fx, fy, cx, cy] = camera.intrinsics;
    let held = |slope: f64, focal: f64, principal: f64, size: usize| {
        let size = size as f64;
        let beyond = 0.3 * 0.5 * size / focal;
        slope.clamp(-(principal / focal + beyond), (size - principal) / focal + beyond)
    };
    let [tx, ty] = [held(p.x / p.z, fx, cx, camera.size[0]), held(p.y / p.z, fy, cy, camera.size[1])];
    // Jacobian of (fx x / z, fy y / z).
    let u = DVec3::new(fx, 0.0, -fx * tx) / p.z;
    let v = DVec3::new(0.0, fy, -fy * ty) / p.z;
    [u, v].map(|row| (spread.transpose() * row).into())
}

fn tiles(center: [f64; 2], radii: [f64; 2], size: [usize; 2]) -> [[u32; 2]; 2] {
    let count = size.map(|pixels| (pixels as f64 / TILE).ceil());
    let tile = |axis: usize, edge: f64| (edge / TILE).clamp(0.0, count[axis]);
    let first = [0, 1].map(|axis| tile(axis, center[axis] - radii[axis]).floor() as u32);
    let end = [0, 1].map(|axis| tile(axis, center[axis] + radii[axis]).ceil() as u32);
    [first, end]
}
