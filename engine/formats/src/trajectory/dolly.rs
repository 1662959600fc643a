use super::super::{Camera, Intrinsics};
use super::path;
use crate::{Error, Result};

/// A camera that moves toward or away from its subject.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dolly {
    /// Start.
    pub camera: Camera,
    /// Distance of the subject along the view axis, in world units.
    pub distance: f64,
    /// Fraction of the distance traveled, below 1; negative moves away.
    pub travel: f64,
    /// Dolly zoom: focal lengths keep the subject's size.
    pub zoom: bool,
}

impl Dolly {
    /// # Errors
    /// [`Error::Argument`] if the subject is not in front, or the camera would reach it.
    pub fn validate(&self) -> Result<()> {
        if !(self.distance > 0.0 && self.distance.is_finite()) {
            return Err(Error::argument("distance of a dolly's subject", self.distance, "a positive one, in front"));
        }
        if !(self.travel < 1.0 && self.travel.is_finite()) {
            return Err(Error::argument("travel of a dolly", self.travel, "a share of the distance, below 1"));
        }
        Ok(())
    }

    /// Returns the camera at a fraction of the path, 0 to 1.
    pub fn at(&self, fraction: f64) -> Camera {
        let moved = self.travel * fraction;
        let mut camera = self.camera;
        camera.pose.translation += moved * self.distance * camera.pose.rotation.z_axis;
        if self.zoom {
            let Intrinsics { fx, fy, .. } = camera.intrinsics;
            camera.intrinsics = Intrinsics { fx: fx * (1.0 - moved), fy: fy * (1.0 - moved), ..camera.intrinsics };
        }
        camera
    }

    /// Returns `frames` cameras from start to end.
    pub fn sample(&self, frames: usize) -> Vec<Camera> {
        path(frames).map(|fraction| self.at(fraction)).collect()
    }
}
