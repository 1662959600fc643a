//! Cameras from PnP, rays and decoder values, on the host in f64.
//!
//! PnP: P3P, LO-RANSAC (Chum, Matas, Kittler, Locally Optimized RANSAC, 2003), refinement.

mod adjust;
mod decoded;
mod focal;
mod p3p;
mod rays;

pub use decoded::{camera_to_world, decoded_camera};
pub(crate) use focal::{FocalView, share_focal_lengths};
pub use rays::RayMap;

use crate::{
    Error, Result,
    random::Random,
    types::{Camera, Intrinsics, Pose},
};
use adjust::{adjusted, error};
use focal::weighted_median;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// A world point and its pixel (centers at +0.5).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correspondence {
    /// In world space.
    pub point: DVec3,
    /// From the top left corner.
    pub pixel: DVec2,
}

/// An estimated camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraEstimate {
    /// Camera in the points' world.
    pub camera: Camera,
    /// Inlier pairs.
    pub inliers: usize,
    /// All pairs.
    pub pairs: usize,
}

/// Camera search options.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RansacOptions {
    /// Inlier threshold in pixels.
    pub tolerance: f64,
    /// Known focal length in pixels.
    pub focal: Option<f64>,
    /// Random seed.
    pub seed: u64,
}

/// Minimum inliers: four points nearly always fit.
pub const MIN_CORRESPONDENCES: usize = 6;
/// With a known focal length.
const TRIES: usize = 1000;
const CERTAINTY: f64 = 0.9999;
/// Relative to the longer side, for 100 to 20 degrees.
const FOCALS: [f64; 9] = [0.42, 0.53, 0.66, 0.83, 1.04, 1.3, 1.63, 2.04, 2.84];
const TRIES_OF_FOCAL: usize = 200;
const ROUNDS: usize = 3;

/// Estimates a camera of `[width, height]` pixels with a centered principal point.
///
/// # Errors
/// [`Error::Argument`] for fewer than [`MIN_CORRESPONDENCES`] pairs or inliers, or invalid options.
pub fn find_camera(
    pairs: &[Correspondence],
    [width, height]: [u32; 2],
    search: &RansacOptions,
) -> Result<CameraEstimate> {
    let expected = || format!("{MIN_CORRESPONDENCES} or more");
    for (name, length) in [("focal length", search.focal), ("tolerance", Some(search.tolerance))] {
        if let Some(length) = length.filter(|length| !(length.is_normal() && *length > 0.0)) {
            return Err(Error::argument(format!("{name} of a camera"), length, "pixels above 0"));
        }
    }
    if pairs.len() < MIN_CORRESPONDENCES {
        return Err(Error::argument("points to find a camera of", pairs.len(), expected()));
    }
    let (w, h) = (f64::from(width), f64::from(height));
    let lens = |focal: f64| Intrinsics { width, height, fx: focal, fy: focal, cx: w / 2.0, cy: h / 2.0 };
    let mut ransac = Ransac { pairs, search, random: Random::new(search.seed), best: None };
    match search.focal {
        Some(focal) => ransac.run(&lens(focal), TRIES),
        None => FOCALS.iter().for_each(|inlier_ratio| ransac.run(&lens(inlier_ratio * w.max(h)), TRIES_OF_FOCAL)),
    }
    let found = ransac.best.map(|(_, camera)| (camera, agreeing(&camera, pairs, search.tolerance).len()));
    match found {
        Some((camera, inliers)) if inliers >= MIN_CORRESPONDENCES => {
            Ok(CameraEstimate { camera, inliers, pairs: pairs.len() })
        }
        found => {
            let inliers = found.map_or(0, |(_, inliers)| inliers);
            let found = format!("{inliers} of {}", pairs.len());
            Err(Error::argument("points that agree on a camera", found, expected()))
        }
    }
}

/// Estimates cameras of one lens, by default with their weighted median focal length.
pub fn find_cameras(
    pairs: &[Vec<Correspondence>],
    size: [u32; 2],
    focal: Option<f64>,
    tolerance: f64,
) -> Vec<Result<CameraEstimate>> {
    let find = |focal: Option<f64>| -> Vec<Result<CameraEstimate>> {
        let find = |(i, pairs): (usize, &Vec<Correspondence>)| {
            find_camera(pairs, size, &RansacOptions { tolerance, focal, seed: i as u64 })
        };
        pairs.par_iter().enumerate().map(find).collect()
    };
    let found = find(focal);
    let weighted = |found: &CameraEstimate| (found.camera.intrinsics.fx, found.inliers as f64);
    let mut focals: Vec<(f64, f64)> = found.iter().flatten().map(weighted).collect();
    match focal {
        None if focals.len() > 1 => find(weighted_median(&mut focals)),
        _ => found,
    }
}

struct Ransac<'a> {
    pairs: &'a [Correspondence],
    search: &'a RansacOptions,
    random: Random,
    best: Option<(f64, Camera)>,
}

impl Ransac<'_> {
    fn run(&mut self, lens: &Intrinsics, tries: usize) {
        // Costs of other lenses do not stop this one.
        let (mut cost, mut needed, mut tried) = (f64::INFINITY, tries, 0);
        while tried < needed {
            tried += 1;
            let Some(camera) = self.sample(lens) else { continue };
            let found = self.cost(&camera);
            if found >= cost {
                continue;
            }
            let camera = self.optimized(camera);
            cost = self.cost(&camera).min(found);
            let inlier_ratio =
                agreeing(&camera, self.pairs, self.search.tolerance).len() as f64 / self.pairs.len() as f64;
            needed = needed.min(needed_tries(inlier_ratio));
            if self.best.is_none_or(|(best, _)| cost < best) {
                self.best = Some((cost, camera));
            }
        }
    }

    fn sample(&mut self, lens: &Intrinsics) -> Option<Camera> {
        let mut chosen = [0; 3];
        for i in 0..3 {
            let mut next = self.random.below(self.pairs.len() - i);
            let mut before = chosen[..i].to_vec();
            before.sort_unstable();
            before.into_iter().for_each(|other| next += usize::from(next >= other));
            chosen[i] = next;
        }
        let chosen = chosen.map(|i| self.pairs[i]);
        let bearing = |pair: Correspondence| {
            let DVec2 { x, y } = pair.pixel;
            DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0).normalize()
        };
        let poses = p3p::poses(chosen.map(|pair| pair.point), chosen.map(bearing));
        let cameras = poses.into_iter().map(|pose: Pose| Camera { intrinsics: *lens, pose });
        cameras.map(|camera| (self.cost(&camera), camera)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, camera)| camera)
    }

    fn optimized(&self, mut camera: Camera) -> Camera {
        let (tolerance, lens) = (self.search.tolerance, self.search.focal.is_none());
        let mut cost = self.cost(&camera);
        for _ in 0..ROUNDS {
            let inliers = agreeing(&camera, self.pairs, tolerance);
            if inliers.len() < MIN_CORRESPONDENCES {
                break;
            }
            let moved = adjusted(&camera, &inliers, tolerance / 4.0, lens);
            let next = self.cost(&moved);
            if next >= cost {
                break;
            }
            (camera, cost) = (moved, next);
        }
        camera
    }

    /// MSAC: relative squared errors, capped at 1.
    fn cost(&self, camera: &Camera) -> f64 {
        let most = self.search.tolerance * self.search.tolerance;
        let square =
            |pair: &Correspondence| error(camera, pair).map_or(1.0, |error| (error.length_squared() / most).min(1.0));
        self.pairs.iter().map(square).sum()
    }
}

fn agreeing(camera: &Camera, pairs: &[Correspondence], tolerance: f64) -> Vec<Correspondence> {
    let agrees = |pair: &&Correspondence| error(camera, pair).is_some_and(|error| error.length() < tolerance);
    pairs.iter().filter(agrees).copied().collect()
}

fn needed_tries(inlier_ratio: f64) -> usize {
    let all_good = inlier_ratio.powi(3).clamp(1e-9, 1.0 - 1e-9);
    ((1.0 - CERTAINTY).ln() / (1.0 - all_good).ln()).ceil() as usize
}

#[cfg(test)]
mod tests;
