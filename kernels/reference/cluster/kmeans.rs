//! k-means (Lloyd 1982) from evenly spaced tokens; the first of tied targets wins.

use super::mean::mean;
use super::nearest::{nearest, two_nearest};
use crate::ops::gather_rows::gather_rows;

const ITERATIONS: usize = 5;

pub struct Clusters {
    /// `[K, width]`, zero for empty clusters.
    pub centroids: Vec<f64>,
    /// Clusters per round, assigned before the centroids move.
    pub assignments: Vec<Vec<u32>>,
    /// Token nearest to each final centroid.
    pub nearest: Vec<u32>,
    /// Relative gap to the second nearest token.
    pub gaps: Vec<f64>,
}

pub fn cluster_count(tokens: usize, ratio: f64) -> usize {
    ((tokens as f64 * ratio) as usize).max(1)
}

/// Returns initial tokens: f32 `linspace(0, N - 1, K)`, rounded half to even.
pub fn initial_indices(tokens: usize, k: usize) -> Vec<u32> {
    if k == 1 {
        return vec![0];
    }
    let last = (tokens - 1) as f32;
    let step = last / (k - 1) as f32;
    let place = |i: usize| if i < k / 2 { step * i as f32 } else { (-step).mul_add((k - 1 - i) as f32, last) };
    (0..k).map(|i| place(i).round_ties_even() as u32).collect()
}

/// Clusters `x [N, width]`.
pub fn kmeans(x: &[f64], width: usize, k: usize) -> Clusters {
    let mut centroids = gather_rows(x, width, &initial_indices(x.len() / width, k));
    let mut assignments = Vec::new();
    for _ in 0..ITERATIONS {
        let assignment = nearest(x, &centroids, width);
        centroids = mean(x, &assignment, k, width);
        assignments.push(assignment);
    }
    let gap = |near: f64, far: f64| if far > 0.0 { (far - near) / far } else { 0.0 };
    Clusters {
        nearest: nearest(&centroids, x, width),
        gaps: two_nearest(&centroids, x, width).iter().map(|[near, far]| gap(near.1, far.1)).collect(),
        centroids,
        assignments,
    }
}
