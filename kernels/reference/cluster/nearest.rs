use rayon::prelude::*;

/// Relative tolerance of tied squared distances.
pub const TIE: f64 = 1.0 / 65536.0;

/// Finds the first of `targets [M, width]` that ties with the nearest, per point.
pub fn nearest(points: &[f64], targets: &[f64], width: usize) -> Vec<u32> {
    let squared = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    let nearest_of = |point: &[f64]| {
        let distances: Vec<f64> = targets.chunks(width).map(|target| squared(point, target)).collect();
        let least = distances.iter().copied().fold(f64::INFINITY, f64::min);
        distances.iter().position(|distance| *distance <= least * (1.0 + TIE)).expect("a target") as u32
    };
    points.par_chunks(width).map(nearest_of).collect()
}

/// Finds the two nearest `targets [M, width]` per point, lower indices first; a lone target twice.
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

/// Returns twice the error bound of kernels/cluster/nearest_matrix.comp for these lengths.
pub fn error_of_products([point, target]: [f64; 2], width: usize) -> f64 {
    const CHUNK: usize = 64;
    const U: f64 = f32::EPSILON as f64 / 2.0;
    let gamma = |n: usize| n as f64 * U / (1.0 - n as f64 * U);
    let halves = 3.0 * (-22f64).exp2() + (-27f64).exp2() * (width as f64).sqrt();
    let products = (gamma(6 * CHUNK.min(width) + width.div_ceil(CHUNK) + 1) + halves) * point * target;
    let norm = gamma(width / 16 + 134) * target * target / 2.0;
    2.0 * (products + norm + 2.0 * U * (point + target).powi(2))
}
