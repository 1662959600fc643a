use glam::{DMat3, DQuat, DVec3};

use super::super::{Camera, Intrinsics, Pose, quaternion_from_matrix};
use super::{closed_path, ellipse::focus, path};
use crate::{Error, Result};

/// Relative to the mean, since cameras at one center still turn.
const LEAST_INTERVAL: f64 = 0.1;
/// Minimum cosine between a camera's axis and the direction to a common target.
const LOOKING: f64 = 0.9;

/// A path through control cameras. Centers: centripetal Catmull-Rom (Yuksel et al. 2011), without
/// cusps or loops. Rotations: squad (Shoemake 1987). Intrinsics: linear. If all cameras look at a
/// common target, the path does, too.
#[derive(Clone, Debug)]
pub struct Spline {
    keys: Vec<Key>,
    intervals: Vec<f64>,
    targets: Option<Vec<DVec3>>,
}

#[derive(Clone, Debug)]
struct Key {
    camera: Camera,
    rotation: DQuat,
    velocity: DVec3,
    control: DQuat,
}

impl Spline {
    /// Creates a path from the first camera to the last, or back to the first if `closed`.
    ///
    /// # Errors
    /// [`Error::Argument`] without cameras or for different picture sizes.
    pub fn through(cameras: &[Camera], closed: bool) -> Result<Self> {
        let Some(first) = cameras.first() else {
            return Err(Error::argument("cameras of a spline", "none", "at least one"));
        };
        let size = |lens: &Intrinsics| format!("{}x{}", lens.width, lens.height);
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate(&format!("camera {i}"))?;
            let (found, expected) = (size(&camera.intrinsics), size(&first.intrinsics));
            if found != expected {
                return Err(Error::argument(
                    format!("size of camera {i}"),
                    found,
                    format!("{expected}, the first one's"),
                ));
            }
        }
        let intervals = intervals(cameras, closed && cameras.len() > 1);
        let mut keys: Vec<Key> = cameras.iter().map(Key::at_rest).collect();
        for i in 0..keys.len() {
            (keys[i].velocity, keys[i].control) = tangents(&keys, &intervals, i);
        }
        Ok(Self { keys, intervals, targets: targets(cameras) })
    }

    /// Returns the camera at a position from 0 to [`Spline::segments`]; `i` is control camera `i`.
    pub fn at(&self, position: f64) -> Camera {
        let position = position.clamp(0.0, self.segments() as f64);
        let (segment, t) = (position as usize, position.fract());
        let key = &self.keys[segment % self.keys.len()];
        if t == 0.0 {
            return key.camera;
        }
        let next = &self.keys[(segment + 1) % self.keys.len()];
        let translation = hermite(key, next, self.intervals[segment], t);
        let mut rotation =
            slerp(slerp(key.rotation, next.rotation, t), slerp(key.control, next.control, t), 2.0 * t * (1.0 - t));
        if let Some(targets) = &self.targets {
            // Smoothstep: continuous speed at the cameras.
            let target = targets[segment].lerp(targets[(segment + 1) % targets.len()], t * t * (3.0 - 2.0 * t));
            let [axis, wanted] = [rotation * DVec3::Z, target - translation].map(DVec3::normalize_or_zero);
            rotation = DQuat::from_rotation_arc(axis, wanted) * rotation;
        }
        let pose = Pose { rotation: DMat3::from_quat(rotation.normalize()), translation };
        Camera { intrinsics: mix(&key.camera.intrinsics, &next.camera.intrinsics, t), pose }
    }

    /// Returns the number of segments.
    pub fn segments(&self) -> usize {
        self.intervals.len()
    }

    /// Returns `frames` cameras at equal times; closed paths do not repeat the first.
    pub fn sample(&self, frames: usize) -> Vec<Camera> {
        let closed = self.segments() == self.keys.len();
        let total: f64 = self.intervals.iter().sum();
        let camera = |fraction: f64| self.at(self.position(fraction * total));
        if closed { closed_path(frames).map(camera).collect() } else { path(frames).map(camera).collect() }
    }

    fn position(&self, mut time: f64) -> f64 {
        for (i, interval) in self.intervals.iter().enumerate() {
            if time < *interval {
                return i as f64 + time / interval;
            }
            time -= interval;
        }
        self.segments() as f64
    }
}

impl Key {
    fn at_rest(camera: &Camera) -> Self {
        let [w, x, y, z] = quaternion_from_matrix(&camera.pose.rotation);
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        Self { camera: *camera, rotation, velocity: DVec3::ZERO, control: rotation }
    }
}

fn targets(cameras: &[Camera]) -> Option<Vec<DVec3>> {
    let center = cameras.iter().map(|camera| camera.pose.translation).sum::<DVec3>() / cameras.len() as f64;
    let focus = focus(cameras, center);
    let target = |camera: &Camera| {
        let (axis, way) = (camera.pose.rotation.z_axis, focus - camera.pose.translation);
        let depth = way.dot(axis);
        (depth > 0.0 && depth >= LOOKING * way.length()).then(|| camera.pose.translation + depth * axis)
    };
    cameras.iter().map(target).collect()
}

/// Returns centripetal knot intervals, bounded relative to their mean; equal if still.
fn intervals(cameras: &[Camera], closed: bool) -> Vec<f64> {
    let next = cameras.iter().cycle().skip(1);
    let segments = if closed { cameras.len() } else { cameras.len() - 1 };
    let distance = |(a, b): (&Camera, &Camera)| a.pose.translation.distance(b.pose.translation);
    let roots: Vec<f64> = cameras.iter().zip(next).take(segments).map(distance).map(f64::sqrt).collect();
    let least = LEAST_INTERVAL * roots.iter().sum::<f64>() / segments.max(1) as f64;
    roots.into_iter().map(|root| if least > 0.0 { root.max(least) } else { 1.0 }).collect()
}

fn tangents(keys: &[Key], intervals: &[f64], i: usize) -> (DVec3, DQuat) {
    let closed = intervals.len() == keys.len();
    let before = i.checked_sub(1).or(closed.then_some(keys.len() - 1));
    let after = Some(i + 1).filter(|&next| next < keys.len()).or(closed.then_some(0));
    let key = &keys[i];
    let step = |other: usize| keys[other].camera.pose.translation - key.camera.pose.translation;
    let turn = |other: usize| log(key.rotation.conjugate() * keys[other].rotation);
    match (before, after) {
        (Some(before), Some(after)) => {
            let (h0, h1) = (intervals[before], intervals[i]);
            let velocity = (-step(before) * (h1 / h0) + step(after) * (h0 / h1)) / (h0 + h1);
            (velocity, key.rotation * exp(-(turn(before) + turn(after)) / 4.0))
        }
        (Some(before), None) => (-step(before) / intervals[before], key.rotation),
        (None, Some(after)) => (step(after) / intervals[i], key.rotation),
        (None, None) => (DVec3::ZERO, key.rotation),
    }
}

fn hermite(from: &Key, to: &Key, interval: f64, t: f64) -> DVec3 {
    let (t2, t3) = (t * t, t * t * t);
    let (start, end) = (from.camera.pose.translation, to.camera.pose.translation);
    start * (2.0 * t3 - 3.0 * t2 + 1.0)
        + end * (3.0 * t2 - 2.0 * t3)
        + interval * (from.velocity * (t3 - 2.0 * t2 + t) + to.velocity * (t3 - t2))
}

/// Returns the rotation vector of the shorter turn, in radians.
fn log(rotation: DQuat) -> DVec3 {
    (if rotation.w < 0.0 { -rotation } else { rotation }).to_scaled_axis()
}

fn exp(turn: DVec3) -> DQuat {
    DQuat::from_scaled_axis(turn)
}

/// glam's slerp approximates the angle.
fn slerp(from: DQuat, to: DQuat, t: f64) -> DQuat {
    from * exp(t * log(from.conjugate() * to))
}

fn mix(from: &Intrinsics, to: &Intrinsics, t: f64) -> Intrinsics {
    let mix = |from: f64, to: f64| from + t * (to - from);
    Intrinsics {
        fx: mix(from.fx, to.fx),
        fy: mix(from.fy, to.fy),
        cx: mix(from.cx, to.cx),
        cy: mix(from.cy, to.cy),
        ..*from
    }
}
