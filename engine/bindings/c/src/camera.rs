//! Cameras.

use super::pointers::Versioned;
use glam::{DMat3, DVec3};
use zipsplat::{Camera, Error, Intrinsics, Pose, Result};

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_camera {
    pub struct_size: u32,
    pub reserved: u32,
    pub width: u32,
    pub height: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub rotation: [f64; 9],
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
