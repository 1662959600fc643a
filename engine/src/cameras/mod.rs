//! Cameras from points of the world and the pixels in which they are seen: perspective-n-point; from the rays of their pixels; and from
//! what a network says of them.
//!
//! Three pairs give a camera (P3P), of many tries that is kept which most pairs agree with (LO-RANSAC: Chum, Matas, Kittler,
//! Locally Optimized RANSAC, 2003), and all of those move it to where they see it best. Everything is f64 on the host.

mod adjust;
mod decoded;
mod focal;
mod p3p;
mod rays;
mod scale;

pub use decoded::decoded_camera;
pub use focal::share_focal_lengths;
pub use rays::RayMap;
pub use scale::scale_between;

use crate::{
    Error, Result,
    random::Random,
    types::{Camera, Intrinsics, Pose},
};
use adjust::{adjusted, error};
use focal::weighted_median;
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// A point of the world and the pixel, of centres at +0.5, in which a camera sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// In the world, in its unit.
    pub point: DVec3,
    /// From the top left corner of the picture.
    pub pixel: DVec2,
}

/// A camera that was found from pairs, or from rays and their pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundCamera {
    /// The camera, in the world of the points.
    pub camera: Camera,
    /// Pairs that agree with it.
    pub inliers: usize,
    /// All pairs that there were.
    pub pairs: usize,
}

/// How a camera is searched for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Search {
    /// Pixels by which a pair may be off and agree.
    pub tolerance: f64,
    /// The focal length in pixels, the same along both axes, where it is known.
    pub focal: Option<f64>,
    /// Seed of the tries. The same pairs and seed give the same bits.
    pub seed: u64,
}

/// Pairs below which a camera is not to be trusted: any four points have one that is nearly right.
pub const FEWEST: usize = 6;
/// Tries at most of each focal length.
const TRIES: usize = 1000;
/// Tries after which the best is likely enough to be of good pairs alone.
const CERTAINTY: f64 = 0.9999;
/// Focal lengths that are tried, as shares of the longer side: from 100 to 20 degrees.
const FOCALS: [f64; 9] = [0.42, 0.53, 0.66, 0.83, 1.04, 1.3, 1.63, 2.04, 2.84];
/// Tries of each of those, before the best is tried on.
const TRIES_OF_FOCAL: usize = 200;
/// Rounds in which a camera is moved and its pairs are chosen anew.
const ROUNDS: usize = 3;

/// The camera with a picture of `[width, height]` pixels and its principal point in the middle that sees `pairs` as they are.
///
/// # Errors
/// [`Error::Argument`] where pairs are fewer than [`FEWEST`], or fewer agree on any camera, and where the focal length or the tolerance is
/// no length.
pub fn find_camera(pairs: &[Pair], [width, height]: [u32; 2], search: &Search) -> Result<FoundCamera> {
    let expected = || format!("{FEWEST} or more");
    for (name, length) in [("focal length", search.focal), ("tolerance", Some(search.tolerance))] {
        if let Some(length) = length.filter(|length| !(length.is_normal() && *length > 0.0)) {
            return Err(Error::argument(format!("{name} of a camera"), length, "pixels above 0"));
        }
    }
    if pairs.len() < FEWEST {
        return Err(Error::argument("points to find a camera of", pairs.len(), expected()));
    }
    let (w, h) = (f64::from(width), f64::from(height));
    let lens = |focal: f64| Intrinsics { width, height, fx: focal, fy: focal, cx: w / 2.0, cy: h / 2.0 };
    let mut ransac = Ransac { pairs, search, random: Random::new(search.seed), best: None };
    match search.focal {
        Some(focal) => ransac.run(&lens(focal), TRIES),
        None => FOCALS.iter().for_each(|share| ransac.run(&lens(share * w.max(h)), TRIES_OF_FOCAL)),
    }
    let found = ransac.best.map(|(_, camera)| (camera, agreeing(&camera, pairs, search.tolerance).len()));
    match found {
        Some((camera, inliers)) if inliers >= FEWEST => Ok(FoundCamera { camera, inliers, pairs: pairs.len() }),
        found => {
            let inliers = found.map_or(0, |(_, inliers)| inliers);
            let found = format!("{inliers} of {}", pairs.len());
            Err(Error::argument("points that agree on a camera", found, expected()))
        }
    }
}

/// The cameras of several pictures of one size and lens, each as [`find_camera`]: with `focal`, or the median of what each picture's
/// pairs say, weighted by how many agree.
pub fn find_cameras(
    pairs: &[Vec<Pair>],
    size: [u32; 2],
    focal: Option<f64>,
    tolerance: f64,
) -> Vec<Result<FoundCamera>> {
    let find = |focal: Option<f64>| -> Vec<Result<FoundCamera>> {
        let find =
            |(i, pairs): (usize, &Vec<Pair>)| find_camera(pairs, size, &Search { tolerance, focal, seed: i as u64 });
        pairs.par_iter().enumerate().map(find).collect()
    };
    let found = find(focal);
    let weighted = |found: &FoundCamera| (found.camera.intrinsics.fx, found.inliers as f64);
    let mut focals: Vec<(f64, f64)> = found.iter().flatten().map(weighted).collect();
    match focal {
        None if focals.len() > 1 => find(weighted_median(&mut focals)),
        _ => found,
    }
}

/// The best camera so far, and its cost.
struct Ransac<'a> {
    pairs: &'a [Pair],
    search: &'a Search,
    random: Random,
    best: Option<(f64, Camera)>,
}

impl Ransac<'_> {
    /// Tries with a lens, until it is certain enough that no better one is to be found.
    fn run(&mut self, lens: &Intrinsics, tries: usize) {
        // Of this lens: a camera with another is no reason to do less.
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
            let share = agreeing(&camera, self.pairs, self.search.tolerance).len() as f64 / self.pairs.len() as f64;
            needed = needed.min(needed_tries(share));
            if self.best.is_none_or(|(best, _)| cost < best) {
                self.best = Some((cost, camera));
            }
        }
    }

    /// The best of the cameras of three random pairs.
    fn sample(&mut self, lens: &Intrinsics) -> Option<Camera> {
        let mut chosen = [0; 3];
        for i in 0..3 {
            // Without those that were chosen before.
            let mut next = self.random.below(self.pairs.len() - i);
            let mut before = chosen[..i].to_vec();
            before.sort_unstable();
            before.into_iter().for_each(|other| next += usize::from(next >= other));
            chosen[i] = next;
        }
        let chosen = chosen.map(|i| self.pairs[i]);
        let bearing = |pair: Pair| {
            let DVec2 { x, y } = pair.pixel;
            DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0).normalize()
        };
        let poses = p3p::poses(chosen.map(|pair| pair.point), chosen.map(bearing));
        let cameras = poses.into_iter().map(|pose: Pose| Camera { intrinsics: *lens, pose });
        cameras.map(|camera| (self.cost(&camera), camera)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, camera)| camera)
    }

    /// A camera moved by the pairs that agree with it, as long as that helps.
    fn optimized(&self, mut camera: Camera) -> Camera {
        let (tolerance, lens) = (self.search.tolerance, self.search.focal.is_none());
        let mut cost = self.cost(&camera);
        for _ in 0..ROUNDS {
            let inliers = agreeing(&camera, self.pairs, tolerance);
            if inliers.len() < FEWEST {
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

    /// Squared errors as shares of the tolerance's square, at most 1 each (MSAC).
    fn cost(&self, camera: &Camera) -> f64 {
        let most = self.search.tolerance * self.search.tolerance;
        let square = |pair: &Pair| error(camera, pair).map_or(1.0, |error| (error.length_squared() / most).min(1.0));
        self.pairs.iter().map(square).sum()
    }
}

fn agreeing(camera: &Camera, pairs: &[Pair], tolerance: f64) -> Vec<Pair> {
    let agrees = |pair: &&Pair| error(camera, pair).is_some_and(|error| error.length() < tolerance);
    pairs.iter().filter(agrees).copied().collect()
}

/// Tries after which three good pairs were among them, where this share of all is good.
fn needed_tries(share: f64) -> usize {
    let all_good = share.powi(3).clamp(1e-9, 1.0 - 1e-9);
    ((1.0 - CERTAINTY).ln() / (1.0 - all_good).ln()).ceil() as usize
}

#[cfg(test)]
mod tests;
