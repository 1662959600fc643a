//! Nearest points.

use rayon::prelude::*;

/// For each of `points [N, width]` the two nearest of `targets [M, width]` with their distances, lower indices first among
/// equals; a lone target twice. Distances from differences, never from products.
pub fn two_nearest(points: &[f64], targets: &[f64], width: usize) -> Vec<[(u32, f64); 2]> {
    points.par_chunks(width).map(|point| two_nearest_of(point, targets)).collect()
}

fn two_nearest_of(point: &[f64], targets: &[f64]) -> [(u32, f64); 2] {
    let mut best = [(0, f64::INFINITY); 2];
    for (i, target) in targets.chunks(point.len()).enumerate() {
        let distance = point.iter().zip(target).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        if distance < best[0].1 {
            best = [(i as u32, distance), best[0]];
        } else if distance < best[1].1 {
            best[1] = (i as u32, distance);
        }
    }
    best
}
