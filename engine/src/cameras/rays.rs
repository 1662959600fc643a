//! Cameras from the rays of their pixels.
//!
//! A ray's direction is d ~ R K^-1 p. The matrix A = R K^-1 is what all rays agree on, a homography: the least squares of d x A p over
//! unit vectors, weighted anew by how well each ray agrees (Holland and Welsch 1977). A's orthogonal and triangular factors are R
//! and K^-1, principal point included. Everything is f64 on the host.

use super::FoundCamera;
use crate::{
    Error, Result,
    types::{Camera, Intrinsics, Pose},
};
use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, SMatrix, SymmetricEigen};

/// Rays of a view's pixels, on a grid of its own.
#[derive(Clone, Debug)]
pub struct RayMap {
    /// Rays of a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Directions in the world, of any length.
    pub directions: Vec<[f32; 3]>,
    /// Origins in the world: the camera's centre, for each ray by itself.
    pub origins: Vec<[f32; 3]>,
    /// Confidences, from 1 on.
    pub confidence: Vec<f32>,
}

/// Rounds in which rays are weighted anew.
const ROUNDS: usize = 30;
/// A ray whose angle is so many typical ones off has a quarter of its weight.
const TYPICAL: f64 = 2.0;
/// Radians by which a ray may be off and agree.
const TOLERANCE: f64 = 0.1;
/// Share of the rays that must agree.
const AGREEING: f64 = 0.5;

/// A ray and the pixel that it is of.
struct Ray {
    /// The ray's direction, of length 1.
    direction: DVec3,
    /// The pixel's direction where the picture reaches from -1 to 1 at distance 1, of length 1.
    pixel: DVec3,
    origin: DVec3,
    weight: f64,
}

impl RayMap {
    /// The camera with a picture of `[width, height]` pixels that these are the rays of, its principal point found like the rest.
    ///
    /// # Errors
    /// [`Error::Argument`] where fewer than half of the rays agree on a camera, or the lists are not as long as the grid.
    pub fn camera(&self, [width, height]: [u32; 2]) -> Result<FoundCamera> {
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
        let centre = agreeing.iter().map(|ray| ray.weight * ray.origin).sum::<DVec3>() / weight;
        let half = |side: u32| f64::from(side) / 2.0;
        let intrinsics = Intrinsics {
            width,
            height,
            fx: lens.x_axis.x * half(width),
            fy: lens.y_axis.y * half(height),
            cx: (lens.z_axis.x + 1.0) * half(width),
            cy: (lens.z_axis.y + 1.0) * half(height),
        };
        let camera = Camera { intrinsics, pose: Pose { rotation, translation: centre } };
        camera.validate("camera of rays")?;
        Ok(FoundCamera { camera, inliers: agreeing.len(), pairs })
    }

    /// The rays that have a direction.
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

/// The angle between a ray and where a map has it, in radians.
fn angle(map: &DMat3, ray: &Ray) -> f64 {
    (*map * ray.pixel).angle_between(ray.direction)
}

/// The map from pixels to directions, up to scale, that most rays agree on; the identity where there are none.
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

/// The matrix A of length 1 with the least weighted sum of |d x A p|^2, of the sign by which rays point forward.
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

/// The rotation R and the lens K, with 1 as its last value, of a map R K^-1; none for a mirror or a map to a plane.
fn factors(map: &DMat3) -> Option<(DMat3, DMat3)> {
    let qr = Matrix3::from_column_slice(&map.to_cols_array()).qr();
    let (q, r) = (qr.q(), qr.r());
    let sign = Matrix3::from_diagonal(&r.diagonal().map(|x| if x < 0.0 { -1.0 } else { 1.0 }));
    let (q, r) = (q * sign, sign * r);
    let inverse = r.try_inverse()?;
    let lens = DMat3::from_cols_slice(inverse.as_slice()) * r[(2, 2)];
    (q.determinant() > 0.0 && lens.is_finite()).then(|| (DMat3::from_cols_slice(q.as_slice()), lens))
}
