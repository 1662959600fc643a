//! Resizing of whole photos for depth networks.

use std::borrow::Borrow;

use rayon::prelude::*;

use super::{
    Image,
    preprocess::{PATCH, PixelMap, View},
    resample::{cubic, resize_bicubic},
};
use crate::{Error, Result};

/// A depth network's way of resizing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fitting {
    /// Depth Anything 3: the longest side to the bound, as OpenCV.
    LongestSide,
    /// VGGT: the width to the bound, as Pillow; taller photos are cropped to a square. The longest
    /// side to the bound if sizes differ.
    Width,
}

impl Fitting {
    /// Returns the bound of the networks' authors.
    pub fn default_bound(self) -> u32 {
        match self {
            Self::LongestSide => 504,
            Self::Width => 518,
        }
    }
}

const A: f64 = -0.75;
const BITS: i32 = 11;

/// Resizes `count` photos, which `photo` opens, by default to the network's bound. Crops different
/// sizes to the common center.
///
/// # Errors
/// Those of `photo`, and [`Error::Argument`] if the bound is less than a patch.
pub fn bounded_views<P: Borrow<Image>>(
    count: usize,
    photo: impl Fn(usize) -> Result<P> + Sync,
    fitting: Fitting,
    bound: Option<u32>,
) -> Result<Vec<View>> {
    let bound = bound.unwrap_or(fitting.default_bound());
    let scaled = |longest: bool| -> Result<Vec<View>> {
        let view = |i: usize| {
            let photo = photo(i)?;
            let photo = photo.borrow();
            let image = match fitting {
                Fitting::LongestSide => bounded(photo, bound)?,
                Fitting::Width => widened(photo, bound, longest)?,
            };
            Ok(View { map: PixelMap::resized([photo.width, photo.height], [image.width, image.height]), image })
        };
        let views: Vec<Result<View>> = (0..count).into_par_iter().map(view).collect();
        views.into_iter().collect()
    };
    let mut views = scaled(false)?;
    let size = |view: &View| [view.image.width, view.image.height];
    if fitting == Fitting::Width && views.iter().any(|view| size(view) != size(&views[0])) {
        views = scaled(true)?;
    }
    let least = |side: fn(&Image) -> u32| views.iter().map(|view| side(&view.image)).min().unwrap_or_default();
    let (width, mut height) = (least(|image| image.width), least(|image| image.height));
    if fitting == Fitting::Width {
        height = height.min(bound / PATCH * PATCH);
    }
    for View { image, map } in &mut views {
        let (left, top) = ((image.width - width) / 2, (image.height - height) / 2);
        (map.to, map.offset) = ([width, height], [-f64::from(left), -f64::from(top)]);
        *image = image.crop(left, top, width, height)?;
    }
    Ok(views)
}

/// Resizes a photo to longest side `bound`, rounding sides to multiples of [`PATCH`], ties up.
///
/// # Errors
/// [`Error::Argument`] if the bound is less than a patch.
pub fn bounded(photo: &Image, bound: u32) -> Result<Image> {
    check(photo, bound)?;
    let longest = photo.width.max(photo.height);
    let scale = f64::from(bound) / f64::from(longest);
    let scaled = |side: u32| ((f64::from(side) * scale).round_ties_even() as u32).max(1);
    let first = resized(photo, [scaled(photo.width), scaled(photo.height)], bound > longest)?;
    let nearest = |side: u32| ((side + PATCH / 2) / PATCH * PATCH).max(PATCH);
    let size = [nearest(first.width), nearest(first.height)];
    let grows = size[0] > first.width || size[1] > first.height;
    resized(&first, size, grows)
}

/// Resizes a photo to width, or `longest` side, `bound`, rounded down to a multiple of [`PATCH`],
/// and the other side to the nearest multiple, ties to even.
fn widened(photo: &Image, bound: u32, longest: bool) -> Result<Image> {
    check(photo, bound)?;
    let bound = bound / PATCH * PATCH;
    let from = if longest { photo.width.max(photo.height) } else { photo.width };
    let scaled = |side: u32| {
        let patches = f64::from(side) * (f64::from(bound) / f64::from(from)) / f64::from(PATCH);
        PATCH * (patches.round_ties_even() as u32).max(1)
    };
    resize_bicubic(photo, scaled(photo.width), scaled(photo.height))
}

fn check(photo: &Image, bound: u32) -> Result<()> {
    photo.validate()?;
    if (PATCH..=8192).contains(&bound) {
        return Ok(());
    }
    Err(Error::argument("longest side", bound, format!("{PATCH} to 8192 pixels")))
}

/// Rounds as OpenCV: means in f32, interpolation in fixed point.
fn resized(photo: &Image, [width, height]: [u32; 2], cubic: bool) -> Result<Image> {
    if [photo.width, photo.height] == [width, height] {
        return Ok(photo.clone());
    }
    let taps = if cubic { cubic_taps } else { area_taps };
    let kept = |x: f64| if cubic { x } else { f64::from(x as f32) };
    let sum = |taps: &[(usize, f64)], value: &dyn Fn(usize) -> f64| {
        taps.iter().fold(0.0, |sum, (at, weight)| kept(sum + kept(weight * value(*at))))
    };
    let (xs, ys) = (taps(photo.width, width), taps(photo.height, height));
    let across = |line: &[u8]| -> Vec<f64> {
        xs.iter().flat_map(|x| [0, 1, 2].map(|c| sum(x, &|at| f64::from(line[3 * at + c])))).collect()
    };
    let lines: Vec<Vec<f64>> = photo.rgb.par_chunks(3 * photo.width as usize).map(across).collect();
    let round = |x: f64| if cubic { (x + 0.5).floor() } else { x.round_ties_even() }.clamp(0.0, 255.0) as u8;
    let down = |y: &Vec<(usize, f64)>| (0..3 * xs.len()).map(|i| round(sum(y, &|at| lines[at][i]))).collect::<Vec<_>>();
    let rgb = ys.par_iter().flat_map_iter(down).collect();
    Ok(Image { width, height, rgb, mask: photo.resized_mask([width, height]) })
}

fn area_taps(inputs: u32, outputs: u32) -> Vec<Vec<(usize, f64)>> {
    let scale = f64::from(inputs) / f64::from(outputs);
    let tap = |i: u32| {
        let (start, end) = (f64::from(i) * scale, (f64::from(i + 1) * scale).min(f64::from(inputs)));
        let covered = |at: usize| ((at as f64 + 1.0).min(end) - (at as f64).max(start)) / (end - start);
        let places = start as usize..(end.ceil() as usize).min(inputs as usize);
        // OpenCV drops slivers.
        places
            .map(|at| (at, f64::from(covered(at) as f32)))
            .filter(|(_, fraction)| fraction * (end - start) > 1e-3)
            .collect()
    };
    (0..outputs).map(tap).collect()
}

fn cubic_taps(inputs: u32, outputs: u32) -> Vec<Vec<(usize, f64)>> {
    let scale = f64::from(inputs) / f64::from(outputs);
    let unit = f64::from(1 << BITS);
    let tap = |i: u32| {
        let place = (f64::from(i) + 0.5) * scale - 0.5;
        let t = place - place.floor();
        let weights = [1.0 + t, t, 1.0 - t, 2.0 - t].map(|x| cubic(x, A));
        let at = |k: usize| (place.floor() as i64 - 1 + k as i64).clamp(0, i64::from(inputs) - 1) as usize;
        (0..4).map(|k| (at(k), (weights[k] * unit).round_ties_even() / unit)).collect()
    };
    (0..outputs).map(tap).collect()
}
