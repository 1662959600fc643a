//! Decimation by merging similar neighbors.
//!
//! Pairs of near neighbors are merged in rounds, cheapest first. The cost is the Bhattacharyya
//! distance of the two Gaussians (Bhattacharyya 1943) plus their squared color distance, times the
//! smaller visibility. A merged Gaussian has the pair's mean and covariance, weighted by
//! visibility.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, SymmetricEigen};
use rayon::prelude::*;

use super::{
    Edited,
    selection::{center, tree},
};
use crate::{Scene, quaternion_from_matrix};

const NEIGHBORS: usize = 16;
/// Fraction of the Gaussians merged in a round.
const ROUND: f64 = 0.2;
/// Weight of a squared distance of coefficients of degree 0.
const COLOR: f64 = 0.4;
/// Least standard deviation relative to the largest of a Gaussian.
const FLATTEST: f64 = 1e-3;

pub(super) fn decimate(edited: &mut Edited, count: usize) -> String {
    let before = edited.scene.len();
    while edited.scene.len() > count {
        let left = edited.scene.len();
        merge(edited, (left - count).min(((left as f64 * ROUND) as usize).max(1)));
    }
    format!("{} merged into neighbors", before - edited.scene.len())
}

#[derive(Clone, Copy)]
struct Blob {
    mean: DVec3,
    covariance: DMat3,
    determinant: f64,
    weight: f64,
    color: DVec3,
}

fn blob(scene: &Scene, i: usize, weight: f32) -> Blob {
    let [w, x, y, z] = scene.quats[i].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = scene.scales[i].map(f64::from);
    let least = FLATTEST * scales.iter().fold(f64::MIN_POSITIVE, |a, b| a.max(*b));
    let variances = DVec3::from_array(scales.map(|scale| scale.max(least).powi(2)));
    Blob {
        mean: center(scene, i),
        covariance: rotation * DMat3::from_diagonal(variances) * rotation.transpose(),
        determinant: variances.element_product(),
        weight: f64::from(weight).max(f64::MIN_POSITIVE),
        color: scene.sh_coeffs[i * scene.sh_coeffs_per_gaussian()].map(f64::from).into(),
    }
}

fn cost(a: &Blob, b: &Blob) -> f64 {
    let (between, apart) = (0.5 * (a.covariance + b.covariance), a.mean - b.mean);
    let overlap = apart.dot(between.inverse() * apart) / 8.0;
    let shape = 0.5 * (between.determinant() / (a.determinant * b.determinant).sqrt()).ln();
    a.weight.min(b.weight) * (overlap + shape + COLOR * a.color.distance_squared(b.color))
}

fn merge(edited: &mut Edited, most: usize) {
    let scene = &mut edited.scene;
    let weights = scene.visibilities();
    let blobs: Vec<Blob> = (0..scene.len()).into_par_iter().map(|i| blob(scene, i, weights[i])).collect();
    let tree = tree(scene);
    let pairs_of = |i: usize| {
        let near = tree.nearest_neighbor_iter(blobs[i].mean.to_array()).map(|other| other.data);
        let near: Vec<usize> = near.filter(|j| *j != i).take(NEIGHBORS).collect();
        near.into_iter().map(|j| (cost(&blobs[i], &blobs[j]), i.min(j), i.max(j))).collect::<Vec<_>>()
    };
    let mut pairs: Vec<(f64, usize, usize)> = (0..scene.len()).into_par_iter().flat_map_iter(pairs_of).collect();
    pairs.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let (mut used, mut gone) = (vec![false; scene.len()], vec![false; scene.len()]);
    let free = |(_, i, j): &(f64, usize, usize)| {
        let free = !used[*i] && !used[*j];
        (used[*i], used[*j]) = (true, true);
        free
    };
    let chosen: Vec<(f64, usize, usize)> = pairs.into_iter().filter(free).take(most).collect();
    for (_, i, j) in chosen {
        replace(scene, [i, j], [&blobs[i], &blobs[j]]);
        gone[j] = true;
        if weights[j] > weights[i] {
            edited.sources[i] = edited.sources[j];
        }
    }
    let kept: Vec<usize> = (0..gone.len()).filter(|i| !gone[*i]).collect();
    edited.keep(&kept);
}

fn replace(scene: &mut Scene, [i, j]: [usize; 2], [a, b]: [&Blob; 2]) {
    let part = a.weight / (a.weight + b.weight);
    let mix = |a: f64, b: f64| b + part * (a - b);
    let apart = a.mean - b.mean;
    let outer = DMat3::from_cols(apart * apart.x, apart * apart.y, apart * apart.z);
    let covariance = part * a.covariance + (1.0 - part) * b.covariance + part * (1.0 - part) * outer;
    let eigen = SymmetricEigen::new(Matrix3::from_column_slice(&covariance.to_cols_array()));
    let mut axes = DMat3::from_cols_slice(eigen.eigenvectors.as_slice());
    if axes.determinant() < 0.0 {
        axes.z_axis = -axes.z_axis;
    }
    let k = scene.sh_coeffs_per_gaussian();
    scene.means[i] = (b.mean + part * apart).as_vec3().to_array();
    scene.scales[i] = std::array::from_fn(|axis| eigen.eigenvalues[axis].max(0.0).sqrt() as f32);
    scene.quats[i] = quaternion_from_matrix(&axes).map(|value| value as f32);
    for c in 0..k {
        let [from, other] = [i, j].map(|at| scene.sh_coeffs[at * k + c]);
        scene.sh_coeffs[i * k + c] = std::array::from_fn(|rgb| mix(from[rgb].into(), other[rgb].into()) as f32);
    }
    // The union is as visible as both, but no more opaque than both overlaid.
    let [first, second] = [i, j].map(|at| f64::from(scene.opacities[at]));
    let area = scene.area(i).max(f32::MIN_POSITIVE);
    let opacity = (a.weight + b.weight) / f64::from(area);
    scene.opacities[i] = opacity.min(1.0 - (1.0 - first) * (1.0 - second)) as f32;
}
