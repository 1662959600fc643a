//! Checks of proposed views, with few rays.

use glam::{Vec2, Vec3A};
use zipsplat::types::median;

use super::path::View;
use super::world::World;

pub(super) const GRID: usize = 12;
/// Share of surfaces in a view.
const LEAST_SURFACE: f32 = 0.55;
/// Nearest distance relative to the median.
const NEAREST: f32 = 0.22;

/// Share of a view's surfaces visible in each of [`WITNESSES`] other views.
pub const LEAST_OVERLAP: f32 = 0.35;
pub const WITNESSES: usize = 2;

/// In pixels, with a centered principal point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lens {
    pub width: usize,
    pub height: usize,
    pub focal: f32,
}

impl Lens {
    /// In camera space, with z = 1.
    pub fn ray(&self, x: f32, y: f32) -> Vec3A {
        Vec3A::new((x - 0.5 * self.width as f32) / self.focal, (y - 0.5 * self.height as f32) / self.focal, 1.0)
    }

    fn shows(&self, p: Vec3A) -> bool {
        let half = Vec2::new(self.width as f32, self.height as f32) / (2.0 * self.focal);
        p.z > 0.0 && p.x.abs() <= half.x * p.z && p.y.abs() <= half.y * p.z
    }

    pub fn grid(&self, view: View) -> impl Iterator<Item = Vec3A> {
        let at = |k: usize, side: usize| (k as f32 + 0.5) / GRID as f32 * side as f32;
        let (width, height, lens) = (self.width, self.height, *self);
        (0..GRID * GRID).map(move |k| (view.rotation * lens.ray(at(k % GRID, width), at(k / GRID, height))).normalize())
    }
}

/// `None` beyond the limits; see [`super::Capture::overlap`].
pub(super) fn overlap(world: &World, lens: Lens, views: &[View]) -> Option<Vec<f32>> {
    if views.iter().any(|view| world.contains(view.eye)) {
        return None;
    }
    let probe = |view: &View| {
        let hit = |direction: Vec3A| world.distance(view.eye, direction).map(|t| (t, view.eye + direction * t));
        lens.grid(*view).filter_map(hit).collect::<Vec<_>>()
    };
    let probes: Vec<Vec<(f32, Vec3A)>> = views.iter().map(probe).collect();
    let median = median(probes.iter().flatten().map(|(t, _)| f64::from(*t)))? as f32;
    let least = (LEAST_SURFACE * (GRID * GRID) as f32) as usize;
    let worth = |probes: &Vec<(f32, Vec3A)>| probes.len() >= least && probes.iter().all(|(t, _)| *t > NEAREST * median);
    if !probes.iter().all(worth) {
        return None;
    }
    let share = |points: &[(f32, Vec3A)], other: &View| {
        let sees = |point: Vec3A| {
            let slack = 2e-3 * (point - other.eye).length();
            lens.shows(other.rotation.transpose() * (point - other.eye)) && !world.blocked(other.eye, point, slack)
        };
        points.iter().filter(|(_, point)| sees(*point)).count() as f32 / points.len() as f32
    };
    let mut matrix = Vec::with_capacity(views.len() * views.len());
    for (i, points) in probes.iter().enumerate() {
        let row = matrix.len();
        matrix.extend(views.iter().enumerate().map(|(j, other)| if i == j { 1.0 } else { share(points, other) }));
        let witnesses = matrix[row..].iter().enumerate().filter(|(j, seen)| *j != i && **seen >= LEAST_OVERLAP).count();
        if witnesses < WITNESSES.min(views.len() - 1) {
            return None;
        }
    }
    Some(matrix)
}
