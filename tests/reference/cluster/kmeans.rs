//! k-means (Lloyd 1982), five rounds from evenly spaced tokens; distances from differences, never from products.

use rayon::prelude::*;

const ITERATIONS: usize = 5;

/// What k-means of N tokens finds.
pub struct Clusters {
    /// `[K, width]`; a cluster that lost all members has the zero vector.
    pub centroids: Vec<f64>,
    /// Cluster of each token in every round; the last is the result, found before the last centroids.
    pub assignments: Vec<Vec<u32>>,
    /// Token nearest to each final centroid, the first of equals.
    pub nearest: Vec<u32>,
    /// The second nearest token, and how much farther it is relatively.
    pub second: Vec<(u32, f64)>,
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
    let tokens: Vec<&[f64]> = x.chunks(width).collect();
    let mut centroids: Vec<Vec<f64>> =
        initial_indices(tokens.len(), k).into_iter().map(|i| tokens[i as usize].to_vec()).collect();
    let mut assignments = Vec::new();
    for _ in 0..ITERATIONS {
        let assignment: Vec<u32> = tokens.par_iter().map(|token| two_nearest(token, &centroids)[0].0).collect();
        centroids = (0..k as u32)
            .map(|cluster| {
                let members: Vec<&[f64]> =
                    tokens.iter().zip(&assignment).filter(|(_, a)| **a == cluster).map(|(token, _)| *token).collect();
                let count = members.len().max(1) as f64;
                (0..width).map(|j| members.iter().map(|member| member[j]).sum::<f64>() / count).collect()
            })
            .collect();
        assignments.push(assignment);
    }
    let pairs: Vec<_> = centroids.par_iter().map(|centroid| two_nearest(centroid, &tokens)).collect();
    // Relative to the farther; two tokens on the centroid itself are a tie.
    let gap = |near: f64, far: f64| if far > 0.0 { (far - near) / far } else { 0.0 };
    Clusters {
        centroids: centroids.concat(),
        assignments,
        nearest: pairs.iter().map(|[first, _]| first.0).collect(),
        second: pairs.iter().map(|[first, second]| (second.0, gap(first.1, second.1))).collect(),
    }
}

/// The two of `points` nearest to `x` with their distances, lower indices first among equals; a lone point twice.
fn two_nearest(x: &[f64], points: &[impl AsRef<[f64]>]) -> [(u32, f64); 2] {
    let mut best = [(0, f64::INFINITY); 2];
    for (i, point) in points.iter().enumerate() {
        let distance = x.iter().zip(point.as_ref()).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        if distance < best[0].1 {
            best = [(i as u32, distance), best[0]];
        } else if distance < best[1].1 {
            best[1] = (i as u32, distance);
        }
    }
    best
}
