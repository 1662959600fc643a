//! Camera paths.

mod dolly;
mod ellipse;
mod orbit;
mod spline;

pub use dolly::Dolly;
pub use ellipse::{Ellipse, mean_up};
pub use orbit::Orbit;
pub use spline::Spline;

use glam::{DMat3, DVec3};

/// Returns steps from 0 to 1, inclusive.
fn path(frames: usize) -> impl Iterator<Item = f64> {
    (0..frames).map(move |i| i as f64 / (frames - 1).max(1) as f64)
}

/// Returns steps from 0 to 1, exclusive.
fn closed_path(frames: usize) -> impl Iterator<Item = f64> {
    (0..frames).map(move |i| i as f64 / frames as f64)
}

/// Returns the rotation (columns right, down, forward) of an upright camera. `right` applies to a
/// vertical `forward`, a unit vector.
fn looking(forward: DVec3, up: DVec3, right: DVec3) -> DMat3 {
    let level = forward.cross(up);
    let right = if level.length() < 1e-6 { right } else { level.normalize() };
    DMat3::from_cols(right, forward.cross(right), forward)
}
