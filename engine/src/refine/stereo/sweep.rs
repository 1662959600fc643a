//! Source: Collins, A space-sweep approach to true multi-image matching (1996), with normalized
//! cross-correlation of windows.

use super::{AGREEING, Photo, pairs::Pairing};
use crate::types::Intrinsics;
use glam::{DMat3, DVec3};

/// Planes, evenly spaced in inverse depth.
const PLANES: usize = 96;
const RADIUS: usize = 3;
const WINDOW: usize = 2 * RADIUS + 1;
/// Variance of gray levels.
const NOISE: f32 = 4.0;
/// Sources whose correlations count, since others may not see a surface.
const BEST: usize = 3;

/// By pixel.
pub(super) struct Depths {
    pub depths: Vec<f32>,
    /// Mean correlation of the best sources; 0 if unknown.
    pub scores: Vec<f32>,
}

#[derive(Clone, Copy, Default)]
struct Best {
    plane: usize,
    score: f32,
    /// Scores of the planes before and behind it.
    beside: [f32; 2],
}

pub(super) fn sweep(photo: &Photo, photos: &[Photo]) -> Depths {
    let Pairing { sources, range } = &photo.pairing;
    let count = photo.gray.len();
    let [near, far] = range.map(f64::recip);
    let inverse = |plane: f64| near + (far - near) * plane / (PLANES - 1) as f64;
    let windows = Windows::new(photo);
    let mut best = vec![Best::default(); count];
    let mut before = vec![0.0; count];
    let used = BEST.min(sources.len());
    for plane in (0..PLANES).filter(|_| sources.len() >= AGREEING) {
        let mut scores = vec![[0.0f32; BEST]; count];
        for source in sources {
            let source = &photos[*source];
            let (warped, inside) = warp(&homography(photo, source, inverse(plane as f64)), photo.size(), source);
            windows.correlate(&warped, &inside, |pixel, score| insert(&mut scores[pixel], score));
        }
        for ((best, before), scores) in best.iter_mut().zip(&mut before).zip(scores) {
            let score = scores.iter().sum::<f32>() / used as f32;
            if score > best.score {
                *best = Best { plane, score, beside: [*before, 0.0] };
            } else if plane == best.plane + 1 {
                best.beside[1] = score;
            }
            *before = score;
        }
    }
    let found = best.iter().map(|best| {
        let is_inner = (1..PLANES - 1).contains(&best.plane);
        let [first, last] = best.beside;
        // Vertex of the parabola through three scores.
        let curvature = first + last - 2.0 * best.score;
        let offset = if curvature < 0.0 { (0.5 * (first - last) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
        let depth = inverse(best.plane as f64 + f64::from(offset)).recip();
        (depth as f32, if is_inner { best.score } else { 0.0 })
    });
    let (depths, scores) = found.unzip();
    Depths { depths, scores }
}

/// Keeps the largest scores, in falling order.
fn insert(scores: &mut [f32; BEST], mut score: f32) {
    for kept in scores {
        let larger = kept.max(score);
        score = kept.min(score);
        *kept = larger;
    }
}

/// Maps pixels of `photo` to those of `source`, at a plane of its camera.
fn homography(photo: &Photo, source: &Photo, inverse_depth: f64) -> DMat3 {
    let [from, to] = [photo, source].map(|photo| &photo.view.camera);
    let matrix = |i: &Intrinsics| DMat3::from_cols_array(&[i.fx, 0.0, 0.0, 0.0, i.fy, 0.0, i.cx, i.cy, 1.0]);
    let to_source = to.pose.inverse().compose(&from.pose);
    let mut mapped = to_source.rotation;
    mapped.z_axis += inverse_depth * to_source.translation;
    matrix(&to.intrinsics) * mapped * matrix(&from.intrinsics).inverse()
}

/// Gray levels of `source` by pixel of the swept photo, if inside.
fn warp(map: &DMat3, [width, height]: [usize; 2], source: &Photo) -> (Vec<f32>, Vec<bool>) {
    let [columns, rows] = source.size();
    let [last_x, last_y] = [columns, rows].map(|side| side.saturating_sub(1) as f32);
    let mut warped = vec![0.0; width * height];
    let mut inside = vec![false; width * height];
    let step = map.x_axis.as_vec3();
    for y in 0..height {
        let first = (*map * DVec3::new(0.5, y as f64 + 0.5, 1.0)).as_vec3();
        for x in 0..width {
            let at = first + x as f32 * step;
            let [u, v] = [at.x / at.z - 0.5, at.y / at.z - 0.5];
            if at.z > 0.0 && (0.0..last_x).contains(&u) && (0.0..last_y).contains(&v) {
                let (i, j) = (u as usize, v as usize);
                let [u, v] = [u - i as f32, v - j as f32];
                let row = |j: usize| {
                    let [left, right] = [0, 1].map(|k| source.gray[j * columns + i + k]);
                    left + u * (right - left)
                };
                let [top, bottom] = [row(j), row(j + 1)];
                warped[y * width + x] = top + v * (bottom - top);
                inside[y * width + x] = true;
            }
        }
    }
    (warped, inside)
}

struct Windows<'a> {
    photo: &'a Photo,
    means: Vec<f32>,
    variances: Vec<f32>,
}

impl<'a> Windows<'a> {
    fn new(photo: &'a Photo) -> Self {
        let squares = photo.gray.iter().map(|gray| gray * gray).collect();
        let [means, squares] = [photo.gray.clone(), squares].map(|values| window_means(&values, photo.size()[0]));
        let variances = means.iter().zip(squares).map(|(mean, square)| square - mean * mean).collect();
        Self { photo, means, variances }
    }

    /// Passes windows inside both photos, with their correlation, to `found`.
    fn correlate(&self, warped: &[f32], inside: &[bool], mut found: impl FnMut(usize, f32)) {
        let [width, height] = self.photo.size();
        let squares: Vec<f32> = warped.iter().map(|gray| gray * gray).collect();
        let products: Vec<f32> = warped.iter().zip(&self.photo.gray).map(|(a, b)| a * b).collect();
        let [means, squares, products] = [warped, &squares, &products].map(|values| window_means(values, width));
        for y in RADIUS..height.saturating_sub(RADIUS) {
            for x in RADIUS..width.saturating_sub(RADIUS) {
                let pixel = y * width + x;
                // The source's outline is convex.
                let corners = [-1, 1].map(|side: isize| pixel.wrapping_add_signed(side * (RADIUS * width) as isize));
                if corners.iter().all(|row| inside[row - RADIUS] && inside[row + RADIUS]) {
                    let covariance = products[pixel] - means[pixel] * self.means[pixel];
                    let variance = squares[pixel] - means[pixel] * means[pixel];
                    found(pixel, covariance / ((variance + NOISE) * (self.variances[pixel] + NOISE)).sqrt());
                }
            }
        }
    }
}

/// Means of windows around pixels; meaningless at the border.
fn window_means(values: &[f32], width: usize) -> Vec<f32> {
    let sums = |values: &[f32], stride: usize| {
        let mut sums = vec![0.0; values.len()];
        let reach = RADIUS * stride;
        if values.len() > 2 * reach {
            let inner = &mut sums[reach..values.len() - reach];
            for k in 0..WINDOW {
                let shifted = &values[k * stride..];
                inner.iter_mut().zip(shifted).for_each(|(sum, value)| *sum += value);
            }
        }
        sums
    };
    let area = (WINDOW * WINDOW) as f32;
    sums(&sums(values, 1), width).iter().map(|sum| sum / area).collect()
}
