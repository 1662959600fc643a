//! Image resizing that gives the same numbers as Pillow's LANCZOS and as PyTorch's antialiased bilinear filter.

use std::f64::consts::PI;
use std::ops::Range;

use rayon::prelude::*;

use super::Image;
use crate::{Error, Result};

/// Pillow's `resize(.., LANCZOS)` on 8-bit RGB: two passes in fixed point with 8 bits between them. A pass whose size
/// already matches is skipped.
///
/// # Errors
/// [`Error::Argument`] when a side is zero or the picture's fields disagree.
pub fn resize_lanczos(image: &Image, width: u32, height: u32) -> Result<Image> {
    image.validate()?;
    check_not_empty(width, height)?;
    let rgb = resize(&image.rgb, [image.width, image.height], [width, height], lanczos_taps);
    Image::new(width, height, rgb)
}

/// PyTorch's `interpolate(.., mode="bilinear", antialias=True)` of `image / 255`: `[height][width][rgb]` f32, not clamped.
/// Weights are f32 as in ATen, which moves results by up to 3e-5 against f64 weights.
///
/// # Errors
/// As [`resize_lanczos`].
pub fn resize_bilinear(image: &Image, width: u32, height: u32) -> Result<Vec<f32>> {
    image.validate()?;
    check_not_empty(width, height)?;
    let rgb: Vec<f32> = image.rgb.iter().map(|&value| f32::from(value) / 255.0).collect();
    Ok(resize(&rgb, [image.width, image.height], [width, height], bilinear_taps))
}

fn check_not_empty(width: u32, height: u32) -> Result<()> {
    if width == 0 || height == 0 {
        return Err(Error::argument("image size", format!("{width}x{height}"), "no empty side"));
    }
    Ok(())
}

/// The inputs that one output is made of: `weights[i]` belongs to input `first + i`.
struct Taps<W> {
    first: usize,
    weights: Vec<W>,
}

/// A sample and the arithmetic its filter works in.
trait Sample: Copy + Default + Send + Sync {
    type Weight: Copy + Send + Sync;
    type Sum: Copy;
    const ZERO: Self::Sum;
    fn add(sum: Self::Sum, weight: Self::Weight, sample: Self) -> Self::Sum;
    fn finish(sum: Self::Sum) -> Self;
}

/// Fraction bits of Pillow's weights: 32 less 8 of the sample and 2 for overshoot.
const FRACTION_BITS: u32 = 22;

impl Sample for u8 {
    type Weight = i32;
    type Sum = i32;
    const ZERO: i32 = 1 << (FRACTION_BITS - 1);
    fn add(sum: i32, weight: i32, sample: u8) -> i32 {
        sum + weight * i32::from(sample)
    }
    fn finish(sum: i32) -> u8 {
        (sum >> FRACTION_BITS).clamp(0, 255) as u8
    }
}

impl Sample for f32 {
    type Weight = f32;
    type Sum = f32;
    const ZERO: f32 = 0.0;
    fn add(sum: f32, weight: f32, sample: f32) -> f32 {
        sum + weight * sample
    }
    fn finish(sum: f32) -> f32 {
        sum
    }
}

fn resize<S: Sample>(
    rgb: &[S],
    [width, height]: [u32; 2],
    [to_width, to_height]: [u32; 2],
    taps: fn(inputs: u32, outputs: u32) -> Vec<Taps<S::Weight>>,
) -> Vec<S> {
    let horizontal = (width != to_width).then(|| filter_rows(rgb, width as usize, &taps(width, to_width)));
    let wide = horizontal.as_deref().unwrap_or(rgb);
    match height != to_height {
        true => filter_columns(wide, 3 * to_width as usize, &taps(height, to_height)),
        false => horizontal.unwrap_or_else(|| rgb.to_vec()),
    }
}

fn filter_rows<S: Sample>(rgb: &[S], width: usize, taps: &[Taps<S::Weight>]) -> Vec<S> {
    let mut filtered = vec![S::default(); rgb.len() / width * taps.len()];
    let rows = filtered.par_chunks_exact_mut(3 * taps.len()).zip(rgb.par_chunks_exact(3 * width));
    rows.for_each(|(out, row)| {
        for (pixel, tap) in out.chunks_exact_mut(3).zip(taps) {
            let mut sums = [S::ZERO; 3];
            for (&weight, input) in tap.weights.iter().zip(row[3 * tap.first..].chunks_exact(3)) {
                for c in 0..3 {
                    sums[c] = S::add(sums[c], weight, input[c]);
                }
            }
            pixel.copy_from_slice(&sums.map(S::finish));
        }
    });
    filtered
}

fn filter_columns<S: Sample>(rgb: &[S], row_len: usize, taps: &[Taps<S::Weight>]) -> Vec<S> {
    let mut filtered = vec![S::default(); row_len * taps.len()];
    filtered.par_chunks_exact_mut(row_len).zip(taps).for_each(|(out, tap)| {
        let mut sums = vec![S::ZERO; row_len];
        for (&weight, row) in tap.weights.iter().zip(rgb[row_len * tap.first..].chunks_exact(row_len)) {
            for (sum, &sample) in sums.iter_mut().zip(row) {
                *sum = S::add(*sum, weight, sample);
            }
        }
        for (sample, sum) in out.iter_mut().zip(sums) {
            *sample = S::finish(sum);
        }
    });
    filtered
}

fn lanczos_taps(inputs: u32, outputs: u32) -> Vec<Taps<i32>> {
    let scale = f64::from(inputs) / f64::from(outputs);
    let stretch = scale.max(1.0);
    let taps = |output: u32| {
        let centre = (f64::from(output) + 0.5) * scale;
        let Range { start, end } = window(centre - 3.0 * stretch, centre + 3.0 * stretch, inputs);
        let weights: Vec<f64> = (start..end).map(|i| lanczos3((i as f64 - centre + 0.5) / stretch)).collect();
        let total: f64 = weights.iter().sum();
        // `as` truncates, so half away from zero is added first.
        let fixed = |w: &f64| (w / total * f64::from(1 << FRACTION_BITS) + 0.5f64.copysign(*w)) as i32;
        Taps { first: start, weights: weights.iter().map(fixed).collect() }
    };
    (0..outputs).map(taps).collect()
}

fn lanczos3(x: f64) -> f64 {
    let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
    if (-3.0..3.0).contains(&x) { sinc(x) * sinc(x / 3.0) } else { 0.0 }
}

fn bilinear_taps(inputs: u32, outputs: u32) -> Vec<Taps<f32>> {
    let scale = inputs as f32 / outputs as f32;
    let stretch = scale.max(1.0);
    let taps = |output: u32| {
        let centre = scale * (output as f32 + 0.5);
        let Range { start, end } = window(f64::from(centre - stretch), f64::from(centre + stretch), inputs);
        let triangle = |i: usize| (1.0 - ((i as f32 - centre + 0.5) * (1.0 / stretch)).abs()).max(0.0);
        let weights: Vec<f32> = (start..end).map(triangle).collect();
        let total: f32 = weights.iter().sum();
        Taps { first: start, weights: weights.iter().map(|w| w / total).collect() }
    };
    (0..outputs).map(taps).collect()
}

/// The inputs whose centres lie within `low..high`, which both libraries find by truncating after adding a half.
fn window(low: f64, high: f64, inputs: u32) -> Range<usize> {
    (low + 0.5).max(0.0) as usize..((high + 0.5) as usize).min(inputs as usize)
}
