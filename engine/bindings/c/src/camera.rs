//! Cameras.

use super::{
    pointers::{Versioned, read_array},
    status::Failure,
};
use glam::{DMat3, DVec3};
use zipsplat::{Camera, Intrinsics, Pose};

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

versioned!(zs_camera { reserved });

impl From<&Camera> for zs_camera {
    fn from(camera: &Camera) -> Self {
        let Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose } = *camera;
        let (rotation, translation) = (pose.rotation.transpose().to_cols_array(), pose.translation.to_array());
        Self { width, height, fx, fy, cx, cy, rotation, translation, ..Versioned::new() }
    }
}

impl From<&zs_camera> for Camera {
    fn from(camera: &zs_camera) -> Self {
        let zs_camera { width, height, fx, fy, cx, cy, .. } = *camera;
        let rotation = DMat3::from_cols_array(&camera.rotation).transpose();
        let pose = Pose { rotation, translation: DVec3::from_array(camera.translation) };
        Self { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose }
    }
}

/// # Safety
/// As [`read_array`].
pub(super) unsafe fn read_cameras(cameras: *const zs_camera, count: usize) -> Result<Vec<Camera>, Failure> {
    // SAFETY: the caller's promise.
    Ok(unsafe { read_array(cameras, count, "cameras") }?.iter().map(Camera::from).collect())
}
