use glam::DVec3;

use super::super::{Pose, Scene};
use super::{looking, path};
use crate::{Error, Result};

const RADIUS_QUANTILE: f64 = 0.9;
const RADIUS_MARGIN: f64 = 1.2;
const UP: DVec3 = DVec3::NEG_Y;

/// Cameras on a sphere that look at its center. Angles in degrees: azimuth turns right, elevation
/// up. At 0, 0 a camera looks along +z, as the first view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    /// Center of the sphere.
    pub center: DVec3,
    /// Radius of the sphere.
    pub radius: f64,
}

impl Orbit {
    /// Returns the reference's turntable: center is the per-axis (lower) median of the means,
    /// radius 1.2 times the 0.9 quantile of distances, linearly interpolated.
    ///
    /// # Errors
    /// [`Error::Argument`] if the scene is empty.
    pub fn around(scene: &Scene) -> Result<Self> {
        if scene.is_empty() {
            return Err(Error::argument("scene", "no Gaussians", "at least one to look at"));
        }
        let median = |axis: usize| {
            let mut values: Vec<f32> = scene.means.iter().map(|mean| mean[axis]).collect();
            let middle = (values.len() - 1) / 2;
            f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
        };
        let center = DVec3::from_array([0, 1, 2].map(median));
        let distance = |mean: &[f32; 3]| DVec3::from_array(mean.map(f64::from)).distance(center);
        let spread = quantile(scene.means.iter().map(distance).collect(), RADIUS_QUANTILE);
        Ok(Self { center, radius: RADIUS_MARGIN * spread })
    }

    /// Returns the camera at angles in degrees. At the poles, right is +x.
    pub fn pose(&self, azimuth: f64, elevation: f64) -> Pose {
        let (azimuth, elevation) = (azimuth.to_radians(), elevation.to_radians());
        let toward = DVec3::new(azimuth.sin() * elevation.cos(), -elevation.sin(), -azimuth.cos() * elevation.cos());
        Pose { rotation: looking(-toward, UP, DVec3::X), translation: self.center + self.radius * toward }
    }

    /// Returns `frames` cameras over `degrees` of azimuth from `start`, inclusive.
    pub fn sweep(&self, frames: usize, start: f64, degrees: f64, elevation: f64) -> Vec<Pose> {
        path(frames).map(|t| self.pose(start + degrees * t, elevation)).collect()
    }

    /// Returns `frames` cameras on a figure eight about the front, for scenes without a back.
    pub fn wiggle(&self, frames: usize, azimuth: f64, elevation: f64) -> Vec<Pose> {
        let turn = std::f64::consts::TAU;
        path(frames).map(|t| self.pose(azimuth * (turn * t).sin(), elevation * (2.0 * turn * t).sin())).collect()
    }
}

fn quantile(mut values: Vec<f64>, fraction: f64) -> f64 {
    let rank = fraction * (values.len() - 1) as f64;
    let (_, &mut low, above) = values.select_nth_unstable_by(rank as usize, f64::total_cmp);
    let high = above.iter().copied().min_by(f64::total_cmp).unwrap_or(low);
    low + (high - low) * rank.fract()
}
