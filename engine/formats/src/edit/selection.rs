//! Selections of Gaussians. Each returns the number removed with the reason.

use glam::DVec3;
use rayon::prelude::*;
use rstar::{RTree, primitives::GeomWithData};

use super::Edited;
use crate::{Camera, Scene};

pub(super) type Tree = RTree<GeomWithData<[f64; 3], usize>>;

pub(super) fn center(scene: &Scene, i: usize) -> DVec3 {
    scene.means[i].map(f64::from).into()
}

pub(super) fn tree(scene: &Scene) -> Tree {
    let places = scene.means.iter().enumerate().map(|(i, at)| GeomWithData::new(at.map(f64::from), i));
    RTree::bulk_load(places.collect())
}

fn largest(scene: &Scene, i: usize) -> f64 {
    f64::from(scene.scales[i].into_iter().fold(0.0, f32::max))
}

pub(super) fn select(edited: &mut Edited, hold: impl Fn(usize, DVec3) -> bool + Sync, reason: &str) -> String {
    let before = edited.scene.len();
    let kept: Vec<usize> = (0..before).into_par_iter().filter(|i| hold(*i, center(&edited.scene, *i))).collect();
    if kept.len() < before {
        edited.keep(&kept);
    }
    format!("{} {reason}", before - kept.len())
}

pub(super) fn opacity(edited: &mut Edited, least: f64) -> String {
    let opacities = edited.scene.opacities.clone();
    select(edited, |i, _| f64::from(opacities[i]) >= least, &format!("with an opacity below {least}"))
}

pub(super) fn size(edited: &mut Edited, most: f64) -> String {
    let sizes: Vec<f64> = (0..edited.scene.len()).map(|i| largest(&edited.scene, i)).collect();
    select(edited, |i, _| sizes[i] <= most, &format!("larger than {most:.4}"))
}

pub(super) fn neighbors(edited: &mut Edited, count: usize, radius: f64) -> String {
    let near = neighbor_counts(&edited.scene, count, |_| radius);
    select(edited, |i, _| near[i] >= count, &format!("with fewer than {count} neighbors within {radius:.4}"))
}

fn neighbor_counts(scene: &Scene, most: usize, radius: impl Fn(usize) -> f64 + Sync) -> Vec<usize> {
    let tree = tree(scene);
    // Each center finds itself, too.
    let near = |i: usize| tree.locate_within_distance(scene.means[i].map(f64::from), radius(i).powi(2)).take(most + 1);
    (0..scene.len()).into_par_iter().map(|i| near(i).count() - 1).collect()
}

pub(super) fn views(edited: &mut Edited, cameras: &[Camera], count: usize) -> String {
    let hold = |_, at| cameras.iter().filter(|camera| camera.project(at).is_some()).take(count).count() == count;
    select(edited, hold, &format!("in the pictures of fewer than {count} cameras"))
}

pub(super) fn connected(scene: &Scene, members: &[bool], seeds: &[usize], neighbors: usize) -> Vec<usize> {
    let tree = tree(scene);
    let mut reached = vec![false; scene.len()];
    let mut open: Vec<usize> = seeds.iter().copied().filter(|i| members[*i]).collect();
    open.iter().for_each(|i| reached[*i] = true);
    while let Some(i) = open.pop() {
        let near = tree.nearest_neighbor_iter(scene.means[i].map(f64::from)).take(neighbors + 1);
        for near in near.map(|near| near.data).filter(|near| members[*near]) {
            if !std::mem::replace(&mut reached[near], true) {
                open.push(near);
            }
        }
    }
    (0..scene.len()).filter(|i| reached[*i]).collect()
}

/// These limits keep the held-out PSNR of refined captures. A size limit would drop background.
const CLEAN_OPACITY: f64 = 0.01;
/// Relative to a Gaussian's largest standard deviation, which suits near and far ones.
const CLEAN_RADIUS: f64 = 8.0;

pub(super) fn clean(edited: &mut Edited, cameras: &[Camera]) -> String {
    let mut effects = vec![opacity(edited, CLEAN_OPACITY)];
    let near = neighbor_counts(&edited.scene, 1, |i| CLEAN_RADIUS * largest(&edited.scene, i));
    effects.push(select(edited, |i, _| near[i] > 0, &format!("alone within {CLEAN_RADIUS} times their size")));
    if !cameras.is_empty() {
        // Gaussians beside a picture reach into it.
        let doubled = |camera: &Camera| {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let (left, top) = (-(width as i32 / 2), -(height as i32 / 2));
            Camera { intrinsics: camera.intrinsics.crop(left, top, 2 * width, 2 * height), ..*camera }
        };
        let doubled: Vec<Camera> = cameras.iter().map(doubled).collect();
        let hold = |_, at| doubled.iter().any(|camera| camera.project(at).is_some());
        effects.push(select(edited, hold, "outside all pictures of twice the cameras' size"));
    }
    effects.join(", ")
}
