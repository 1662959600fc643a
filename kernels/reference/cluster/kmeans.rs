//! k-means (Lloyd 1982), five rounds from evenly spaced tokens; distances from differences, never from products. Of targets
//! that tie the first is the nearest.

use super::mean::mean;
use super::nearest::{nearest, two_nearest};
use crate::ops::gather_rows::gather_rows;

const ITERATIONS: usize = 5;

/// The clusters that k-means of N tokens finds.
pub struct Clusters {
    /// `[K, width]`; a cluster that lost all members has the zero vector.
    pub centroids: Vec<f64>,
    /// Cluster of each token in every round; the last is the result, found before the last centroids.
    pub assignments: Vec<Vec<u32>>,
    /// Token nearest to each final centroid, the first of those that tie.
    pub nearest: Vec<u32>,
    /// How much farther the second nearest token is, relatively.
    pub gaps: Vec<f64>,
}

/// K of a compression ratio: `max(1, floor(tokens * ratio))`, multiplied in f64.
pub fn cluster_count(tokens: usize, ratio: f64) -> usize {
    ((tokens as f64 * ratio) as usize).max(1)
}

/// Indices of the K tokens that are the first centroids: f32 `linspace(0, N - 1, K)` rounded half to even.
///
/// torch fills the second half from its end, with one rounding a value (fused multiply and add).
pub fn initial_indices(tokens: usize, k: usize) -> Vec<u32> {
    if k == 1 {
        return vec![0];
    }
    let last = (tokens - 1) as f32;
    let step = last / (k - 1) as f32;
    let place = |i: usize| if i < k / 2 { step * i as f32 } else { (-step).mul_add((k - 1 - i) as f32, last) };
    (0..k).map(|i| place(i).round_ties_even() as u32).collect()
}

/// Clusters `x [N, width]` into K.
pub fn kmeans(x: &[f64], width: usize, k: usize) -> Clusters {
    let mut centroids = gather_rows(x, width, &initial_indices(x.len() / width, k));
    let mut assignments = Vec::new();
    for _ in 0..ITERATIONS {
        let assignment = nearest(x, &centroids, width);
        centroids = mean(x, &assignment, k, width);
        assignments.push(assignment);
    }
    // Relative to the farther; two tokens on the centroid itself are a tie.
    let gap = |near: f64, far: f64| if far > 0.0 { (far - near) / far } else { 0.0 };
    Clusters {
        nearest: nearest(&centroids, x, width),
        gaps: two_nearest(&centroids, x, width).iter().map(|[near, far]| gap(near.1, far.1)).collect(),
        centroids,
        assignments,
    }
}
