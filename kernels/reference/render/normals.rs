//! Normals by inverse iteration on the covariance.

use super::project::{Camera, Gaussians};
use glam::{DMat3, DQuat, DVec3};

/// Returns the shortest axis of Gaussian `i`, world space, facing the camera.
pub fn normal(gaussians: &Gaussians, i: usize, camera: &Camera) -> [f64; 3] {
    let [w, x, y, z] = gaussians.quats[i];
    let axes = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let spread = axes * DMat3::from_diagonal(DVec3::from(gaussians.scales[i]));
    let precision = (spread * spread.transpose()).inverse();
    // Squaring computes the 2^24th power, which isolates the largest eigenvalue.
    let mut power = precision;
    for _ in 0..24 {
        power *= power;
        power *= 1.0 / power.to_cols_array().iter().fold(0.0, |most: f64, v| most.max(v.abs()));
    }
    let columns = [power.x_axis, power.y_axis, power.z_axis];
    let longest = columns.into_iter().max_by(|a, b| a.length().total_cmp(&b.length())).expect("three columns");
    let axis = longest.normalize();
    let towards = camera.center() - DVec3::from(gaussians.means[i]);
    (if axis.dot(towards) < 0.0 { -axis } else { axis }).into()
}
