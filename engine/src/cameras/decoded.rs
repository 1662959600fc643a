use crate::types::{Camera, Intrinsics, Pose, matrix_from_quaternion};
use glam::DVec3;

/// Of a half field of view.
const NARROWEST: f64 = 1e-6;

/// Decodes a centered camera: center 3, camera-to-world quaternion xyzw 4, vertical and horizontal
/// field of view in radians.
pub fn decoded_camera(encoding: &[f32; 9], [width, height]: [u32; 2]) -> Camera {
    let [tx, ty, tz, x, y, z, w, vfov, hfov] = encoding.map(f64::from);
    let focal = |side: u32, fov: f64| f64::from(side) / 2.0 / (fov / 2.0).tan().max(NARROWEST);
    Camera {
        intrinsics: Intrinsics {
            width,
            height,
            fx: focal(width, hfov),
            fy: focal(height, vfov),
            cx: f64::from(width) / 2.0,
            cy: f64::from(height) / 2.0,
        },
        pose: Pose { rotation: matrix_from_quaternion([w, x, y, z]), translation: DVec3::new(tx, ty, tz) },
    }
}
