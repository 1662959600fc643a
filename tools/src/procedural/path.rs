use std::f32::consts::{PI, TAU};
use std::fmt;

use glam::{Mat3A, Vec3A};

use super::rng::Rng;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PathKind {
    /// At least half a circle around the subject.
    Orbit,
    /// At most a quarter circle around the subject.
    Arc,
    /// Toward or past the subject.
    Walk,
    /// Sideways in rows, looking ahead.
    Sweep,
    /// Within arm's reach.
    Handheld,
}

impl fmt::Display for PathKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Orbit => "an orbit",
            Self::Arc => "an arc",
            Self::Walk => "a walk",
            Self::Sweep => "a sweep",
            Self::Handheld => "the spot",
        })
    }
}

impl PathKind {
    pub const ALL: [Self; 5] = [Self::Orbit, Self::Arc, Self::Walk, Self::Sweep, Self::Handheld];
    pub(super) const ALL_AROUND: [Self; 7] =
        [Self::Orbit, Self::Orbit, Self::Orbit, Self::Arc, Self::Walk, Self::Sweep, Self::Handheld];
}

/// In meters and radians.
pub(super) struct Stage {
    pub target: Vec3A,
    /// From the target, for a field of view of 55 degrees.
    pub distance: [f32; 2],
    /// Above the target.
    pub elevation: [f32; 2],
    pub front: f32,
    /// Largest angle from `front`.
    pub freedom: f32,
    pub bounds: [Vec3A; 2],
    pub paths: &'static [PathKind],
}

#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    pub eye: Vec3A,
    /// World from camera; OpenCV axes.
    pub rotation: Mat3A,
}

impl View {
    /// z is up; rolls around the line of sight.
    fn towards(eye: Vec3A, target: Vec3A, roll: f32) -> Self {
        let forward = (target - eye).normalize_or(Vec3A::Y);
        let right = forward.cross(Vec3A::Z).normalize_or(Vec3A::X);
        let level = Mat3A::from_cols(right, forward.cross(right), forward);
        Self { eye, rotation: level * Mat3A::from_rotation_z(roll) }
    }
}

impl Stage {
    /// `span` is the fraction of a full path; `reach` scales distances for the lens.
    pub fn path(&self, kind: PathKind, views: usize, span: f32, reach: f32, rng: &mut Rng) -> Vec<View> {
        let distance = reach * rng.range(self.distance[0], self.distance[1]);
        let unsteady =
            Unsteady { roll: rng.range(0.0, 0.05), aim: rng.range(0.0, 0.04) * distance, step: rng.range(0.0, 0.3) };
        let mut times: Vec<f32> = (0..views)
            .map(|i| (i as f32 + unsteady.step * rng.signed()) / (views.max(2) - 1) as f32)
            .map(|t| (2.0 * t - 1.0).clamp(-1.0, 1.0))
            .collect();
        if rng.chance(0.5) {
            times.iter_mut().for_each(|t| *t = -*t);
        }
        let pairs = match kind {
            PathKind::Orbit => self.around(&times, rng.range(0.42, 1.0) * PI * span, distance, rng),
            PathKind::Arc => self.around(&times, rng.range(0.3, 0.785) * span, distance, rng),
            PathKind::Walk => self.walk(&times, span, distance, rng),
            PathKind::Sweep => self.sweep(&times, span, distance, rng),
            PathKind::Handheld => self.handheld(views, span, distance, rng),
        };
        let [low, high] = self.bounds;
        let steady = |(eye, aim): (Vec3A, Vec3A)| {
            let shake = unsteady.aim * Vec3A::new(rng.signed(), rng.signed(), rng.signed());
            View::towards(eye.clamp(low, high), aim + shake, unsteady.roll * rng.signed())
        };
        pairs.into_iter().map(steady).collect()
    }

    fn direction(azimuth: f32, elevation: f32) -> Vec3A {
        Vec3A::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin())
    }

    fn any_azimuth(&self, half_span: f32, rng: &mut Rng) -> f32 {
        self.front + (self.freedom - half_span).max(0.0) * rng.signed()
    }

    fn around(&self, times: &[f32], half_span: f32, distance: f32, rng: &mut Rng) -> Vec<(Vec3A, Vec3A)> {
        let half_span = half_span.min(self.freedom);
        let (middle, elevation) = (self.any_azimuth(half_span, rng), rng.range(self.elevation[0], self.elevation[1]));
        let (wave, phase) = ([0.1 * rng.unit(), 0.15 * rng.unit()], rng.angle());
        let place = |t: &f32| {
            let swing = (2.0 * t + phase).sin();
            let direction = Self::direction(middle + half_span * t, elevation * (1.0 + wave[1] * swing));
            (self.target + distance * (1.0 + wave[0] * swing) * direction, self.target)
        };
        times.iter().map(place).collect()
    }

    fn walk(&self, times: &[f32], span: f32, distance: f32, rng: &mut Rng) -> Vec<(Vec3A, Vec3A)> {
        let (azimuth, elevation) = (self.any_azimuth(0.3, rng), rng.range(self.elevation[0], self.elevation[1]));
        let start = self.target + distance * Self::direction(azimuth, elevation);
        // 0 heads for the target, a quarter turn passes it.
        let course = azimuth + PI + rng.range(-1.4, 1.4);
        let stride = 0.5 * span * distance * rng.range(0.5, 1.1) * Self::direction(course, 0.0);
        let (curve, bob) = (0.15 * distance * rng.signed() * Self::direction(course + PI / 2.0, 0.0), 0.015 * distance);
        let follow = rng.range(0.0, 0.6);
        let place = |t: &f32| {
            let eye = start + stride * *t + curve * t * t + Vec3A::Z * (bob * (9.0 * t).sin());
            (eye, self.target + follow * stride * *t)
        };
        times.iter().map(place).collect()
    }

    fn sweep(&self, times: &[f32], span: f32, distance: f32, rng: &mut Rng) -> Vec<(Vec3A, Vec3A)> {
        let (azimuth, elevation) = (self.any_azimuth(0.2, rng), rng.range(self.elevation[0], self.elevation[1]));
        let center = self.target + distance * Self::direction(azimuth, elevation);
        let side = 0.5 * span * distance * rng.range(0.5, 2.2) * Self::direction(azimuth + PI / 2.0, 0.0);
        let rise = 0.5 * span * distance * rng.range(0.0, 0.5) * Vec3A::Z;
        // Serpentine rows.
        let rows = if times.len() >= 6 { rng.count(1, 3) as f32 } else { 1.0 };
        let converge = rng.range(0.0, 1.0);
        let place = |t: &f32| {
            let run = rows * (0.5 + 0.5 * t).min(0.999);
            let across = if (run as usize).is_multiple_of(2) { run.fract() } else { 1.0 - run.fract() };
            let lift = if rows > 1.0 { run.floor() / (rows - 1.0) } else { 0.5 };
            let move_by = side * (2.0 * across - 1.0) + rise * (2.0 * lift - 1.0);
            (center + move_by, self.target + (1.0 - converge) * move_by)
        };
        times.iter().map(place).collect()
    }

    fn handheld(&self, views: usize, span: f32, distance: f32, rng: &mut Rng) -> Vec<(Vec3A, Vec3A)> {
        let (azimuth, elevation) = (self.any_azimuth(0.2, rng), rng.range(self.elevation[0], self.elevation[1]));
        let center = self.target + distance * Self::direction(azimuth, elevation);
        let reach = distance * span * rng.range(0.1, 0.35);
        let place = |rng: &mut Rng| {
            let direction = Self::direction(TAU * rng.unit(), rng.range(-0.6, 0.6));
            let aim = 0.12 * distance * Vec3A::new(rng.signed(), rng.signed(), 0.5 * rng.signed());
            (center + reach * rng.unit().sqrt() * direction, self.target + aim)
        };
        (0..views).map(|_| place(rng)).collect()
    }
}

struct Unsteady {
    roll: f32,
    aim: f32,
    step: f32,
}
