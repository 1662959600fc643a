//! Cameras from pixel rays.
//!
//! Directions are d ~ A p with A = R K^-1, found by iteratively reweighted least squares on d x A p
//! (Holland and Welsch 1977) and QR factorization.

use super::CameraEstimate;
use crate::{
    Error, Result,
    types::{Camera, Intrinsics, Pose},
};
use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SMatrix, SymmetricEigen};

/// Rays of a view.
#[derive(Clone, Debug)]
pub struct RayMap {
    /// Width of the grid.
    pub width: u32,
    /// Height of the grid.
    pub height: u32,
    /// World directions, unnormalized.
    pub directions: Vec<[f32; 3]>,
    /// World origins per ray.
    pub origins: Vec<[f32; 3]>,
    /// Confidences, at least 1.
    pub confidence: Vec<f32>,
}

const ROUNDS: usize = 30;
/// Medians at a quarter of the weight.
const TYPICAL: f64 = 2.0;
/// Inlier threshold in radians.
const TOLERANCE: f64 = 0.1;
const AGREEING: f64 = 0.5;

struct Ray {
    direction: DVec3,
    /// Unit direction, for an image spanning -1 to 1 at distance 1.
    pixel: DVec3,
    origin: DVec3,
    weight: f64,
}

impl RayMap {
    /// Estimates a camera of `[width, height]` pixels and its principal point.
    ///
    /// # Errors
    /// [`Error::Argument`] for too few inliers or wrong lengths.
    pub fn camera(&self, [width, height]: [u32; 2]) -> Result<CameraEstimate> {
        let rays = self.rays()?;
        let map = homography(&rays);
        let agrees = |ray: &&Ray| angle(&map, ray) < TOLERANCE;
        let agreeing: Vec<&Ray> = rays.iter().filter(agrees).collect();
        let pairs = self.directions.len();
        let none = |found: String| Error::argument("rays that agree on a camera", found, "at least half of them");
        if agreeing.len() < 4 || (agreeing.len() as f64) < AGREEING * pairs as f64 {
            return Err(none(format!("{} of {pairs}", agreeing.len())));
        }
        let (rotation, lens) = factors(&map).ok_or_else(|| none(format!("{pairs} of a mirrored or flat camera")))?;
        let weight: f64 = agreeing.iter().map(|ray| ray.weight).sum();
        let center = agreeing.iter().map(|ray| ray.weight * ray.origin).sum::<DVec3>() / weight;
        let half = |side: u32| f64::from(side) / 2.0;
        let intrinsics = Intrinsics {
            width,
            height,
            fx: lens.x_axis.x * half(width),
            fy: lens.y_axis.y * half(height),
            cx: (lens.z_axis.x + 1.0) * half(width),
            cy: (lens.z_axis.y + 1.0) * half(height),
        };
        let camera = Camera { intrinsics, pose: Pose { rotation, translation: center } };
        camera.validate("camera of rays")?;
        Ok(CameraEstimate { camera, inliers: agreeing.len(), pairs })
    }

    fn rays(&self) -> Result<Vec<Ray>> {
        let (w, h) = (self.width as usize, self.height as usize);
        let lengths = [self.directions.len(), self.origins.len(), self.confidence.len()];
        if lengths != [w * h; 3] {
            return Err(Error::argument("rays of a map", format!("{lengths:?}"), format!("{w} x {h} of each")));
        }
        let ray = |i: usize| {
            let place = |at: usize, count: usize| (2 * at + 1) as f64 / count as f64 - 1.0;
            Ray {
                direction: DVec3::from(self.directions[i].map(f64::from)).normalize_or_zero(),
                pixel: DVec3::new(place(i % w, w), place(i / w, h), 1.0).normalize(),
                origin: DVec3::from(self.origins[i].map(f64::from)),
                weight: f64::from(self.confidence[i]),
            }
        };
        let usable = |ray: &Ray| ray.direction != DVec3::ZERO && ray.origin.is_finite() && ray.weight > 0.0;
        Ok((0..w * h).map(ray).filter(usable).collect())
    }
}

fn angle(map: &DMat3, ray: &Ray) -> f64 {
    (*map * ray.pixel).angle_between(ray.direction)
}

fn homography(rays: &[Ray]) -> DMat3 {
    let mut map = DMat3::IDENTITY;
    let mut weights: Vec<f64> = rays.iter().map(|ray| ray.weight).collect();
    for _ in 0..ROUNDS {
        map = least_squares(rays, &weights);
        let angles: Vec<f64> = rays.iter().map(|ray| angle(&map, ray)).collect();
        let mut sorted = angles.clone();
        sorted.sort_by(f64::total_cmp);
        let typical = TYPICAL * sorted.get(sorted.len() / 2).map_or(1.0, |median| median.max(1e-12));
        for ((weight, ray), angle) in weights.iter_mut().zip(rays).zip(angles) {
            let length = (map * ray.pixel).length_squared().max(1e-12);
            *weight = ray.weight / (length * (1.0 + (angle / typical).powi(2)).powi(2));
        }
    }
    map
}

/// Unit-norm A with least weighted |d x A p|^2, facing forward.
fn least_squares(rays: &[Ray], weights: &[f64]) -> DMat3 {
    let mut squares = SMatrix::<f64, 9, 9>::zeros();
    for (ray, weight) in rays.iter().zip(weights) {
        let (d, p) = (ray.direction, ray.pixel);
        let cross = [[0.0, -d.z, d.y], [d.z, 0.0, -d.x], [-d.y, d.x, 0.0]];
        for row in cross {
            let row = SMatrix::<f64, 1, 9>::from_fn(|_, i| row[i / 3] * p[i % 3]);
            squares += *weight * row.transpose() * row;
        }
    }
    let eigen = SymmetricEigen::new(squares);
    let values = eigen.eigenvectors.column(eigen.eigenvalues.imin());
    let map = DMat3::from_cols_array(&std::array::from_fn(|i| values[3 * (i % 3) + i / 3]));
    let forward: f64 = rays.iter().zip(weights).map(|(ray, weight)| weight * ray.direction.dot(map * ray.pixel)).sum();
    if forward < 0.0 { map * -1.0 } else { map }
}

/// R and K of a map R K^-1; `None` if mirrored or singular.
fn factors(map: &DMat3) -> Option<(DMat3, DMat3)> {
    let qr = Matrix3::from_column_slice(&map.to_cols_array()).qr();
    let (q, r) = (qr.q(), qr.r());
    let sign = Matrix3::from_diagonal(&r.diagonal().map(|x| if x < 0.0 { -1.0 } else { 1.0 }));
    let (q, r) = (q * sign, sign * r);
    let inverse = r.try_inverse()?;
    let lens = DMat3::from_cols_slice(inverse.as_slice()) * r[(2, 2)];
    (q.determinant() > 0.0 && lens.is_finite()).then(|| (DMat3::from_cols_slice(q.as_slice()), lens))
}
