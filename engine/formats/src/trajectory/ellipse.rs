use glam::{DMat3, DVec3};

use super::super::{Camera, Pose};
use super::{closed_path, looking};
use crate::{Error, Result};

/// Weight of the given center, for parallel view axes.
const CENTER_WEIGHT: f64 = 1e-3;

/// A closed path perpendicular to the cameras' mean up, at their mean height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipse {
    /// Center of the ellipse.
    pub center: DVec3,
    /// Semi-major and semi-minor axes.
    pub axes: [DVec3; 2],
    /// Unit normal of its plane.
    pub up: DVec3,
    /// Target of the cameras: nearest to the given cameras' view axes.
    pub target: DVec3,
    /// Whether cameras look away from the target, as most given ones do.
    pub outward: bool,
    /// Angle of the first camera from the major axis, in radians.
    pub start: f64,
}

impl Ellipse {
    /// Fits the ellipse with the mean and covariance of the camera centers in the plane. For
    /// parallel view axes the target is `center`.
    ///
    /// # Errors
    /// [`Error::Argument`] without cameras, for coincident cameras, or an undefined mean up.
    pub fn around(cameras: &[Camera], center: DVec3) -> Result<Self> {
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("camera {i}"))?;
        }
        let count = cameras.len().max(1) as f64;
        let mean = |value: &dyn Fn(&Camera) -> DVec3| cameras.iter().map(value).sum::<DVec3>() / count;
        let up = mean_up(cameras)?;
        let middle = mean(&|camera| camera.pose.translation);
        let axes = half_axes(cameras, middle, up);
        if axes[0].length() <= 1e-9 * (1.0 + middle.length()) {
            return Err(Error::argument("centers of the cameras", "one place", "several, to lay an ellipse around"));
        }
        let target = focus(cameras, center);
        let toward: f64 = cameras.iter().map(|c| c.pose.rotation.z_axis.dot(target - c.pose.translation)).sum();
        let first = cameras[0].pose.translation - middle;
        // A degenerate ellipse's minor axis has no direction.
        let fraction = |axis: DVec3| first.dot(axis) / axis.length_squared().max(f64::MIN_POSITIVE);
        let start = fraction(axes[1]).atan2(fraction(axes[0]));
        Ok(Self { center: middle, axes, up, target, outward: toward < 0.0, start })
    }

    /// Returns the camera at an angle from the start, in radians.
    pub fn pose(&self, angle: f64) -> Pose {
        let (sin, cos) = (self.start + angle).sin_cos();
        let translation = self.center + cos * self.axes[0] + sin * self.axes[1];
        let toward = if self.outward { translation - self.target } else { self.target - translation };
        // A camera at its own target looks along the path's plane.
        let level = self.axes[0].normalize();
        let forward = toward.try_normalize().unwrap_or(level);
        Pose { rotation: looking(forward, self.up, level), translation }
    }

    /// Returns `frames` cameras once around, without repeating the first.
    pub fn sample(&self, frames: usize) -> Vec<Pose> {
        closed_path(frames).map(|fraction| self.pose(std::f64::consts::TAU * fraction)).collect()
    }
}

/// Returns the normalized mean of the cameras' up vectors.
///
/// # Errors
/// [`Error::Argument`] if their mean vanishes.
pub fn mean_up(cameras: &[Camera]) -> Result<DVec3> {
    let up = cameras.iter().map(|camera| -camera.pose.rotation.y_axis).sum::<DVec3>() / cameras.len().max(1) as f64;
    if up.length() < 1e-3 {
        let found = format!("{up} on the mean of {} cameras", cameras.len());
        return Err(Error::argument("up of the cameras", found, "cameras that agree on one"));
    }
    Ok(up.normalize())
}

/// Returns the point nearest the view axes (least squares), regularized to `center`.
pub(super) fn focus(cameras: &[Camera], center: DVec3) -> DVec3 {
    let weight = CENTER_WEIGHT * cameras.len() as f64;
    let mut normal = weight * DMat3::IDENTITY;
    let mut right = weight * center;
    for camera in cameras {
        let axis = camera.pose.rotation.z_axis.normalize();
        let across = DMat3::IDENTITY - DMat3::from_cols(axis.x * axis, axis.y * axis, axis.z * axis);
        normal += across;
        right += across * camera.pose.translation;
    }
    normal.inverse() * right
}

/// The variance of evenly spread points is half of each squared axis.
fn half_axes(cameras: &[Camera], middle: DVec3, up: DVec3) -> [DVec3; 2] {
    let (u, v) = up.any_orthonormal_pair();
    let (mut uu, mut uv, mut vv) = (0.0, 0.0, 0.0);
    for camera in cameras {
        let offset = camera.pose.translation - middle;
        let (a, b) = (offset.dot(u), offset.dot(v));
        (uu, uv, vv) = (uu + a * a, uv + a * b, vv + b * b);
    }
    let half = 2.0 / cameras.len() as f64;
    let (mean, difference) = ((uu + vv) / 2.0, (uu - vv) / 2.0);
    let spread = difference.hypot(uv);
    let (sin, cos) = (0.5 * uv.atan2(difference)).sin_cos();
    let [long, short] = [mean + spread, (mean - spread).max(0.0)].map(|variance| (half * variance).sqrt());
    [long * (cos * u + sin * v), short * (cos * v - sin * u)]
}
