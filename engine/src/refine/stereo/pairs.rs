//! Photos to match with each other, and their range of depths.

use crate::types::{Camera, PointCloud};
use glam::DVec3;
use rayon::prelude::*;

const SOURCES: usize = 5;
const SAMPLE: usize = 2048;
/// Fewest points in common.
const COMMON: usize = 10;
/// Best angle between rays in degrees, and standard deviations below and above (Yao et al. 2018).
const ANGLE: f64 = 8.0;
const DEVIATIONS: [f64; 2] = [3.0, 15.0];
/// Quantile of points' depths from both ends, and the factor beyond them.
const QUANTILE: f64 = 0.01;
const MARGIN: f64 = 1.4;

#[derive(Default)]
pub(super) struct Pairing {
    /// Other photos, the best first.
    pub sources: Vec<usize>,
    /// Nearest and farthest depth.
    pub range: [f64; 2],
}

pub(super) fn pairings(cameras: &[Camera], cloud: &PointCloud) -> Vec<Pairing> {
    let sample = cloud.positions.iter().step_by(cloud.positions.len().div_ceil(SAMPLE).max(1));
    let points: Vec<DVec3> = sample.map(|at| DVec3::from(at.map(f64::from))).collect();
    let seen: Vec<Vec<Option<f64>>> =
        cameras.par_iter().map(|camera| points.iter().map(|point| Some(camera.project(*point)?.z)).collect()).collect();
    let preference = |i: usize, j: usize| {
        let common = (0..points.len()).filter(|at| seen[i][*at].and(seen[j][*at]).is_some());
        let preferred = common.map(|at| {
            let [a, b] = [i, j].map(|camera| points[at] - cameras[camera].pose.translation);
            let off = a.angle_between(b).to_degrees() - ANGLE;
            (-0.5 * (off / DEVIATIONS[usize::from(off > 0.0)]).powi(2)).exp()
        });
        let (count, sum) = preferred.fold((0, 0.0), |(count, sum), value| (count + 1, sum + value));
        if count < COMMON { 0.0 } else { sum }
    };
    let pairing = |i: usize| {
        let mut depths: Vec<f64> = seen[i].iter().flatten().copied().collect();
        if depths.len() < COMMON {
            return Pairing::default();
        }
        depths.sort_unstable_by(f64::total_cmp);
        let rank = (QUANTILE * depths.len() as f64) as usize;
        let range = [depths[rank] / MARGIN, depths[depths.len() - 1 - rank] * MARGIN];
        let others = (0..cameras.len()).filter(|j| *j != i).map(|j| (preference(i, j), j));
        let mut others: Vec<(f64, usize)> = others.filter(|(preference, _)| *preference > 0.0).collect();
        others.sort_by(|a, b| b.0.total_cmp(&a.0));
        Pairing { sources: others.into_iter().take(SOURCES).map(|(_, j)| j).collect(), range }
    };
    (0..cameras.len()).into_par_iter().map(pairing).collect()
}
