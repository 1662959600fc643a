//! Cameras.

use super::pointers::Versioned;
use glam::{DMat3, DVec3};
use zipsplat::{Camera, Error, Intrinsics, Pose, Result};

/// A pinhole camera with OpenCV axes: x right, y down, z forward. Intrinsics are in pixels, whose
/// centers are at +0.5.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_camera {
    /// sizeof(zs_camera).
    pub struct_size: u32,
    /// Must be 0.
    pub reserved: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point from the left edge.
    pub cx: f64,
    /// Principal point from the top edge.
    pub cy: f64,
    /// Camera-to-world rotation, row-major: columns are the right, down and forward axes.
    pub rotation: [f64; 9],
    /// Camera center in the world.
    pub translation: [f64; 3],
}

versioned!(zs_camera);

impl From<&Camera> for zs_camera {
    fn from(camera: &Camera) -> Self {
        let Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose } = *camera;
        let (rotation, translation) = (pose.rotation.transpose().to_cols_array(), pose.translation.to_array());
        Self { width, height, fx, fy, cx, cy, rotation, translation, ..Versioned::new() }
    }
}

impl zs_camera {
    pub(super) fn camera(&self) -> Result<Camera> {
        let Self { reserved, width, height, fx, fy, cx, cy, .. } = *self;
        if reserved != 0 {
            return Err(Error::argument("zs_camera, reserved", reserved, "0"));
        }
        let rotation = DMat3::from_cols_array(&self.rotation).transpose();
        let pose = Pose { rotation, translation: DVec3::from_array(self.translation) };
        Ok(Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose })
    }
}
