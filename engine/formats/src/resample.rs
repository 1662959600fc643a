//! Image resizing identical to Pillow's LANCZOS and BICUBIC.

use std::f64::consts::PI;
use std::ops::Range;

use rayon::prelude::*;

use super::Image;
use crate::{Error, Result};

/// Half width and value of a filter.
type Filter = (f64, fn(f64) -> f64);

/// Resizes as Pillow's `resize(.., LANCZOS)` on 8-bit RGB: two fixed-point passes, rounded to 8
/// bits between.
///
/// # Errors
/// [`Error::Argument`] if a side is zero.
pub fn resize_lanczos(image: &Image, width: u32, height: u32) -> Result<Image> {
    resize(image, [width, height], (3.0, lanczos3))
}

/// As [`resize_lanczos`], with Pillow's BICUBIC.
pub(crate) fn resize_bicubic(image: &Image, width: u32, height: u32) -> Result<Image> {
    resize(image, [width, height], (2.0, bicubic))
}

fn resize(image: &Image, [width, height]: [u32; 2], filter: Filter) -> Result<Image> {
    image.validate()?;
    if width == 0 || height == 0 {
        return Err(Error::argument("image size", format!("{width}x{height}"), "at least 1 pixel on each side"));
    }
    let horizontal = (width != image.width)
        .then(|| filter_rows(&image.rgb, image.width as usize, &taps(image.width, width, filter)));
    let wide = horizontal.as_deref().unwrap_or(&image.rgb);
    let rgb = if height != image.height {
        filter_columns(wide, 3 * width as usize, &taps(image.height, height, filter))
    } else {
        horizontal.unwrap_or_else(|| image.rgb.clone())
    };
    Ok(Image { width, height, rgb, mask: image.resized_mask([width, height]) })
}

/// Inputs of one output: `weights[i]` applies to input `first + i`.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

/// Fraction bits of Pillow's weights: 32 less 8 for the sample, 2 for overshoot.
const FRACTION_BITS: u32 = 22;
const HALF: i32 = 1 << (FRACTION_BITS - 1);

fn sample(sum: i32) -> u8 {
    (sum >> FRACTION_BITS).clamp(0, 255) as u8
}

fn filter_rows(rgb: &[u8], width: usize, taps: &[Taps]) -> Vec<u8> {
    let mut filtered = vec![0; rgb.len() / width * taps.len()];
    let rows = filtered.par_chunks_exact_mut(3 * taps.len()).zip(rgb.par_chunks_exact(3 * width));
    rows.for_each(|(out, row)| {
        for (pixel, tap) in out.chunks_exact_mut(3).zip(taps) {
            let mut sums = [HALF; 3];
            for (&weight, input) in tap.weights.iter().zip(row[3 * tap.first..].chunks_exact(3)) {
                for c in 0..3 {
                    sums[c] += weight * i32::from(input[c]);
                }
            }
            pixel.copy_from_slice(&sums.map(sample));
        }
    });
    filtered
}

fn filter_columns(rgb: &[u8], row_len: usize, taps: &[Taps]) -> Vec<u8> {
    let mut filtered = vec![0; row_len * taps.len()];
    filtered.par_chunks_exact_mut(row_len).zip(taps).for_each(|(out, tap)| {
        let mut sums = vec![HALF; row_len];
        for (&weight, row) in tap.weights.iter().zip(rgb[row_len * tap.first..].chunks_exact(row_len)) {
            for (sum, &value) in sums.iter_mut().zip(row) {
                *sum += weight * i32::from(value);
            }
        }
        for (value, sum) in out.iter_mut().zip(sums) {
            *value = sample(sum);
        }
    });
    filtered
}

fn taps(inputs: u32, outputs: u32, (half, filter): Filter) -> Vec<Taps> {
    let scale = f64::from(inputs) / f64::from(outputs);
    let stretch = scale.max(1.0);
    let taps = |output: u32| {
        let center = (f64::from(output) + 0.5) * scale;
        let Range { start, end } = window(center - half * stretch, center + half * stretch, inputs);
        let weights: Vec<f64> = (start..end).map(|i| filter((i as f64 - center + 0.5) / stretch)).collect();
        let total: f64 = weights.iter().sum();
        // `as` truncates: adding half rounds away from zero.
        let fixed = |w: &f64| (w / total * f64::from(1 << FRACTION_BITS) + 0.5f64.copysign(*w)) as i32;
        Taps { first: start, weights: weights.iter().map(fixed).collect() }
    };
    (0..outputs).map(taps).collect()
}

fn lanczos3(x: f64) -> f64 {
    let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
    if (-3.0..3.0).contains(&x) { sinc(x) * sinc(x / 3.0) } else { 0.0 }
}

fn bicubic(x: f64) -> f64 {
    cubic(x, -0.5)
}

/// Cubic convolution kernel (Keys 1981) with parameter `a`: -0.5 in Pillow, -0.75 in OpenCV.
pub fn cubic(x: f64, a: f64) -> f64 {
    match x.abs() {
        x if x < 1.0 => ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0,
        x if x < 2.0 => ((a * x - 5.0 * a) * x + 8.0 * a) * x - 4.0 * a,
        _ => 0.0,
    }
}

pub(super) fn window(low: f64, high: f64, inputs: u32) -> Range<usize> {
    (low + 0.5).max(0.0) as usize..((high + 0.5) as usize).min(inputs as usize)
}
