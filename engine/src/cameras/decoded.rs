use crate::types::{Camera, Intrinsics, Pose, matrix_from_quaternion};
use glam::DVec3;

/// Of a half field of view.
const NARROWEST: f64 = 1e-6;

/// Inverts an encoding's world-to-camera pose; rectifies fields of view.
pub fn camera_to_world(encoding: &[f32; 9]) -> [f32; 9] {
    let [tx, ty, tz, x, y, z, w, ..] = encoding.map(f64::from);
    let rotation = matrix_from_quaternion([w, x, y, z]);
    let center = -(rotation.transpose() * DVec3::new(tx, ty, tz)).as_vec3();
    let [.., qx, qy, qz, qw, vfov, hfov] = *encoding;
    [center.x, center.y, center.z, -qx, -qy, -qz, qw, vfov.max(0.0), hfov.max(0.0)]
}

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
