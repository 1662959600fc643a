//! Floaters: Gaussians in initially empty space, which fit one photo and veil pictures of cameras
//! beside it.

use super::growth::INVISIBLE;
use crate::types::{Camera, Intrinsics, Pose, Scene, matrix_from_quaternion};
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use std::array;

/// Cells of a side of a place's picture, twice as wide and high as the camera's: floaters beside a
/// picture reach into it.
const CELLS: usize = 48;
/// Least depth over the least initial one around a cell, and least distance from a place over that
/// of its `ENOUGH`th nearest initial Gaussian.
const RATIO: f64 = 0.3;
/// Fewest initial Gaussians around a cell, and the quantile of depths for fewer.
const ENOUGH: usize = 8;
const QUANTILE: f64 = 0.05;
/// Largest factor of a floater's distance and size; others become invisible.
const MOST_PUSHED: f64 = 10.0;
/// Mahalanobis radius of a Gaussian for cameras inside it.
const INSIDE: f64 = 3.0;
/// Least distance from a place in standard deviations in that direction: projected linearly, wider
/// Gaussians veil the whole picture.
const BESIDE: f64 = 2.0;
/// Places between a camera and its `NEAREST` ones, as fractions of the way. No training photo
/// penalizes floaters there.
const BETWEEN: [f64; 2] = [0.3, 0.5];
const NEAREST: usize = 3;
const MAX_CAMERAS: usize = 64;

/// Places of cameras and between them.
pub(super) struct FreeSpace {
    places: Vec<Place>,
    /// Least depths by cell of the places' pictures.
    depths: Vec<Depths>,
    /// Least distances from the places in any direction, for cameras there that look elsewhere.
    distances: Vec<f64>,
    /// Initial Gaussians around or beside a place.
    around: Vec<bool>,
}

/// Correction of a floater.
#[derive(Clone, Copy)]
enum Correction {
    Hide,
    /// Distance from a place and size, multiplied by a factor.
    Push(DVec3, f64),
    Scale(f64),
}

#[derive(Clone, Copy)]
struct Place {
    ends: [usize; 2],
    along: f64,
}

type Depths = [[f64; CELLS]; CELLS];

impl FreeSpace {
    pub fn new(scene: &Scene, cameras: &[Camera]) -> Self {
        let places = places(cameras);
        let depths = places.par_iter().map(|place| least_depths(scene, &place.camera(cameras))).collect();
        let centers: Vec<DVec3> = places.iter().map(|place| place.camera(cameras).pose.translation).collect();
        let distances = centers.par_iter().map(|center| RATIO * nearest_distance(scene, *center)).collect();
        let around = |i| {
            let [inside, beside] = deviations(scene, i, &centers);
            inside < INSIDE || beside < BESIDE
        };
        let around = (0..scene.len()).into_par_iter().map(around).collect();
        Self { places, depths, distances, around }
    }

    /// Pushes floaters back to the initial scene's depth, at the same size in their camera's
    /// picture, narrows those beside a camera, and hides those around or near one. Returns their
    /// indices. `cameras` are those of [`FreeSpace::new`], moved or not.
    pub fn clear(&self, scene: &mut Scene, cameras: &[Camera]) -> Vec<usize> {
        let compared: Vec<Camera> = self.places.iter().map(|place| place.camera(cameras)).collect();
        let centers: Vec<DVec3> = compared.iter().map(|camera| camera.pose.translation).collect();
        let limits: Vec<f64> = self.depths.iter().map(|depths| RATIO * largest(depths)).collect();
        let pushed = |mean: &[f32; 3]| {
            let push = |((camera, depths), limit): ((&Camera, &Depths), &f64)| {
                if !(0.0..*limit).contains(&depth(camera, mean)) {
                    return None;
                }
                let ([row, column], depth) = cell(camera, mean)?;
                let factor = depths[row][column] / depth;
                let push = || Correction::Push(camera.pose.translation, factor);
                (RATIO * factor > 1.0).then(|| if factor < MOST_PUSHED { push() } else { Correction::Hide })
            };
            compared.iter().zip(&self.depths).zip(&limits).find_map(push)
        };
        let is_near = |i: usize| {
            let [mean, _] = row(scene, i);
            centers.iter().zip(&self.distances).any(|(center, least)| center.distance_squared(mean) < least.powi(2))
        };
        let correction = |i: usize| {
            if scene.opacities[i] <= INVISIBLE {
                return None;
            }
            let is_new = !self.around.get(i).is_some_and(|around| *around);
            let [inside, beside] = if is_new { deviations(scene, i, &centers) } else { [f64::INFINITY; 2] };
            if inside < INSIDE || is_new && is_near(i) {
                return Some(Correction::Hide);
            }
            // Narrower than needed, for rounding.
            let narrowed = || (beside < BESIDE).then_some(Correction::Scale(0.99 * beside / BESIDE));
            pushed(&scene.means[i]).or_else(narrowed)
        };
        let floaters: Vec<_> =
            (0..scene.len()).into_par_iter().filter_map(|i| correction(i).map(|correction| (i, correction))).collect();
        for (i, correction) in &floaters {
            let [mean, scales] = row(scene, *i);
            match *correction {
                Correction::Hide => scene.opacities[*i] = 0.0,
                Correction::Scale(factor) => scene.scales[*i] = (factor * scales).as_vec3().to_array(),
                Correction::Push(center, factor) => {
                    scene.means[*i] = center.lerp(mean, factor).as_vec3().to_array();
                    scene.scales[*i] = (factor * scales).as_vec3().to_array();
                }
            }
        }
        floaters.into_iter().map(|(i, ..)| i).collect()
    }
}

impl Place {
    fn camera(self, cameras: &[Camera]) -> Camera {
        let [from, to] = self.ends.map(|i| cameras[i].pose);
        let [first, second] = [from, to].map(|pose| DQuat::from_mat3(&pose.rotation));
        let rotation = DMat3::from_quat(first.slerp(second, self.along));
        let translation = from.translation.lerp(to.translation, self.along);
        let i = cameras[self.ends[0]].intrinsics;
        let [cx, cy] = [i.cx + 0.5 * f64::from(i.width), i.cy + 0.5 * f64::from(i.height)];
        let intrinsics = Intrinsics { width: 2 * i.width, height: 2 * i.height, cx, cy, ..i };
        Camera { intrinsics, pose: Pose { rotation, translation } }
    }
}

fn places(cameras: &[Camera]) -> Vec<Place> {
    let around = |i: usize| {
        let distance = |j: usize| cameras[i].pose.translation.distance_squared(cameras[j].pose.translation);
        let mut others: Vec<usize> = (0..cameras.len()).filter(|j| *j != i).collect();
        others.sort_by(|a, b| distance(*a).total_cmp(&distance(*b)));
        let between = others.into_iter().take(NEAREST).flat_map(move |j| BETWEEN.map(|along| (j, along)));
        [(i, 0.0)].into_iter().chain(between).map(move |(j, along)| Place { ends: [i, j], along })
    };
    (0..cameras.len()).step_by(cameras.len().div_ceil(MAX_CAMERAS).max(1)).flat_map(around).collect()
}

fn row(scene: &Scene, i: usize) -> [DVec3; 2] {
    [scene.means[i], scene.scales[i]].map(|row| DVec3::from(row.map(f64::from)))
}

/// Least distances of points from a Gaussian in standard deviations: Mahalanobis, and in a point's
/// direction. Both are infinite beyond `INSIDE`.
fn deviations(scene: &Scene, i: usize, points: &[DVec3]) -> [f64; 2] {
    let axes = matrix_from_quaternion(scene.quats[i].map(f64::from)).transpose();
    let [mean, scales] = row(scene, i);
    let limit = (INSIDE * scales.max_element()).powi(2);
    let near = points.iter().filter(|point| point.distance_squared(mean) < limit);
    near.fold([f64::INFINITY; 2], |[inside, beside], point| {
        let local = axes * (*point - mean);
        [inside.min((local / scales).length()), beside.min(local.length_squared() / (local * scales).length())]
    })
}

/// Distance of the `ENOUGH`th nearest Gaussian, or 0.
fn nearest_distance(scene: &Scene, center: DVec3) -> f64 {
    let mut nearest = [f64::INFINITY; ENOUGH];
    for i in 0..scene.len() {
        let distance = center.distance_squared(row(scene, i)[0]);
        if distance < nearest[ENOUGH - 1] {
            nearest[ENOUGH - 1] = distance;
            nearest.sort_unstable_by(f64::total_cmp);
        }
    }
    if scene.len() < ENOUGH { 0.0 } else { nearest[ENOUGH - 1].sqrt() }
}

fn least_depths(scene: &Scene, camera: &Camera) -> Depths {
    let mut cells = [[(f64::INFINITY, 0); CELLS]; CELLS];
    let mut depths = Vec::new();
    let seen = scene.means.iter().filter(|mean| depth(camera, mean) > 0.0).filter_map(|mean| cell(camera, mean));
    for ([row, column], depth) in seen {
        let (least, count) = &mut cells[row][column];
        (*least, *count) = (depth.min(*least), *count + 1);
        depths.push(depth);
    }
    let rank = (QUANTILE * depths.len() as f64) as usize;
    let other = if depths.is_empty() { 0.0 } else { *depths.select_nth_unstable_by(rank, f64::total_cmp).1 };
    let around = |at: usize| at.saturating_sub(1)..(at + 2).min(CELLS);
    array::from_fn(|row| {
        array::from_fn(|column| {
            let near = cells[around(row)].iter().flat_map(|cells| &cells[around(column)]);
            let (depth, count) = near.fold((f64::INFINITY, 0), |(a, n), (b, m)| (a.min(*b), n + m));
            if count < ENOUGH { depth.min(other) } else { depth }
        })
    })
}

fn largest(depths: &Depths) -> f64 {
    depths.as_flattened().iter().copied().fold(0.0, f64::max)
}

fn depth(camera: &Camera, point: &[f32; 3]) -> f64 {
    camera.pose.rotation.z_axis.dot(DVec3::from(point.map(f64::from)) - camera.pose.translation)
}

/// Row and column of a point's cell, and its depth, if the camera sees it.
fn cell(camera: &Camera, point: &[f32; 3]) -> Option<([usize; 2], f64)> {
    let DVec3 { x, y, z } = camera.project(DVec3::from(point.map(f64::from)))?;
    let [row, column] = [(y, camera.intrinsics.height), (x, camera.intrinsics.width)]
        .map(|(at, size)| (at / f64::from(size) * CELLS as f64) as usize);
    Some(([row.min(CELLS - 1), column.min(CELLS - 1)], z))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floaters_are_pushed_back() {
        let cameras = [camera(0.0), camera(0.1)];
        // A near thing on the left, a wall, nothing in the lower half, and one behind the cameras.
        let wall = (0..24).map(|i| [0.4 * (i % 6) as f32 - 0.8, -0.5 * (i / 6) as f32, 4.0]);
        let near = [[-0.4, -0.2, 1.0]];
        let behind = [[0.0, 0.0, -0.5]];
        let given = scene(wall.chain(near).chain(behind).flat_map(|mean| [mean; 8]).collect());
        let free_space = FreeSpace::new(&given, &cameras);
        let places = [
            ([-0.4, -0.2, 1.0], true),
            ([-0.112, -0.056, 0.28], false),
            ([0.4, -0.4, 1.3], true),
            ([0.11, -0.11, 1.1], false),
            ([0.1, 0.6, 1.3], true),
            ([0.0, 0.3, 0.7], false),
            // Beside the pictures.
            ([0.56, 0.0, 0.7], false),
            ([0.0, 0.0, -1.0], true),
            ([0.0, 5.0, 1.0], true),
            ([0.035, -0.035, 0.35], false),
        ];
        let given = scene(places.iter().map(|(mean, _)| *mean).collect());
        let mut moved = given.clone();
        let floaters = free_space.clear(&mut moved, &cameras);
        assert_eq!(floaters, (0..places.len()).filter(|i| !places[*i].1).collect::<Vec<_>>());
        assert!(free_space.clear(&mut moved, &cameras).is_empty());
        // To the first camera they look alike.
        let seen = |scene: &Scene, i: usize| {
            let [x, y, depth] = scene.means[i];
            [x / depth, y / depth, scene.scales[i][0] / depth].map(|value| (1e4 * value).round())
        };
        assert!((0..places.len()).all(|i| seen(&given, i) == seen(&moved, i)));
        assert!(floaters.iter().map(|i| moved.means[*i][2]).eq([1.0, 4.0, 4.0, 4.0, 0.35]));
        // It would become more than ten times as large.
        assert!((0..places.len()).all(|i| (moved.opacities[i] == 0.0) == (i == 9)));
    }

    #[test]
    fn gaussians_around_cameras_become_invisible() {
        let cameras = [camera(0.0), camera(1.0)];
        // Beside the cameras, between them, around both as from the beginning, and behind them.
        let means = vec![[0.0, 0.4, 0.0], [0.5, 0.2, -0.1], [0.5, 0.0, -1.0], [0.0, 0.0, -1.0]];
        let mut given = scene(means.clone());
        given.scales[2] = [1.0; 3];
        let free_space = FreeSpace::new(&given, &cameras);
        assert!(free_space.clear(&mut given, &cameras).is_empty());
        assert!(
            FreeSpace::new(&scene(Vec::new()), &cameras).clear(&mut scene(vec![[0.0, 0.0, 0.5]]), &cameras).is_empty()
        );
        given.scales[0] = [0.01, 0.2, 0.01];
        assert_eq!(free_space.clear(&mut given, &cameras), [0]);
        given.scales[1] = [0.1; 3];
        assert_eq!(free_space.clear(&mut given, &cameras), [1]);
        assert_eq!(given.opacities, [0.0, 0.0, 0.5, 0.5]);
    }

    #[test]
    fn wide_gaussians_beside_cameras_are_narrowed() {
        let cameras = [camera(0.0), camera(1.0)];
        // A needle that passes the cameras at a distance.
        let mut wide = scene(vec![[2.0, 1.0, -1.0]]);
        wide.scales[0] = [1.8, 0.05, 0.05];
        assert!(FreeSpace::new(&wide, &cameras).clear(&mut wide.clone(), &cameras).is_empty());
        let free_space = FreeSpace::new(&scene(Vec::new()), &cameras);
        let was = wide.clone();
        assert_eq!(free_space.clear(&mut wide, &cameras), [0]);
        assert_eq!((&wide.means, &wide.opacities), (&was.means, &was.opacities));
        // Its extent is largest towards the place halfway between.
        let extent = (2.7f64.powi(2) + 2.0 * 0.05f64.powi(2)).sqrt() / 4.25;
        for (now, then) in wide.scales[0].iter().zip(was.scales[0]) {
            assert!((f64::from(now / then) - 0.99 / (BESIDE * extent)).abs() < 1e-6, "{now} of {then}");
        }
        assert!(free_space.clear(&mut wide, &cameras).is_empty());
    }

    #[test]
    fn gaussians_near_cameras_become_invisible() {
        let cameras = [camera(0.0), camera(1.0)];
        let given = scene(vec![[0.5, 0.0, 4.0]; ENOUGH]);
        // Behind the cameras: within 0.3 of the distance, and farther.
        let mut moved = scene(vec![[0.5, 0.0, -1.0], [0.5, 0.0, -1.3]]);
        assert_eq!(FreeSpace::new(&given, &cameras).clear(&mut moved, &cameras), [0]);
        assert_eq!(moved.opacities, [0.0, 0.5]);
    }

    fn camera(x: f64) -> Camera {
        let intrinsics = Intrinsics::from_fov(240, 240, 1.0, 1.0);
        Camera { intrinsics, pose: Pose { translation: DVec3::new(x, 0.0, 0.0), ..Pose::IDENTITY } }
    }

    fn scene(means: Vec<[f32; 3]>) -> Scene {
        let count = means.len();
        Scene {
            means,
            scales: vec![[0.05; 3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacities: vec![0.5; count],
            sh_coeffs: vec![[0.0; 3]; count],
            ..Scene::default()
        }
    }
}
