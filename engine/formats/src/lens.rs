//! Lenses that bend straight lines, and their photos as a pinhole camera would have taken them.

use rayon::prelude::*;

use super::{Image, Intrinsics};
use crate::{Error, Result};

/// How the focal length of the pinhole camera may differ from the lens's: of a fisheye lens, which may see half the world,
/// it does not become less.
const ZOOM: [f64; 2] = [0.7, 4.0];
const FISHEYE_ZOOM: [f64; 2] = [1.0, 4.0];
/// Halvings of the range of zooms.
const HALVINGS: usize = 40;
/// Points of each side of a picture, and steps to each from the middle, by which a zoom is judged.
const SIDE_POINTS: u32 = 16;
const STEPS: u32 = 8;

/// A lens with distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// The intrinsics of the photo as it was taken, pixels.
    pub intrinsics: Intrinsics,
    /// Where directions land instead of where a pinhole would put them.
    pub distortion: Distortion,
}

/// A lens: the map from a direction `(x, y, 1)` to the point that takes its place before the intrinsics are applied.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// OpenCV's, with `r² = x² + y²`: radially by a quotient of polynomials in r², then tangentially.
    Perspective {
        /// k1, k2, k3 and that of r⁸: the numerator is `1 + k1 r² + k2 r⁴ + ...`.
        numerator: [f64; 4],
        /// OpenCV's k4, k5 and k6: the denominator is `1 + k4 r² + ...`.
        denominator: [f64; 3],
        /// p1 and p2.
        tangential: [f64; 2],
    },
    /// OpenCV's fisheye: the distance from the middle is `t (1 + k1 t² + k2 t⁴ + ...)`, where t is the angle from the axis.
    Fisheye([f64; 4]),
}

impl Distortion {
    /// Whether it changes nothing.
    pub fn is_none(&self) -> bool {
        match self {
            Self::Perspective { numerator, denominator, tangential } => {
                numerator.iter().chain(denominator).chain(tangential).all(|k| *k == 0.0)
            }
            Self::Fisheye(_) => false,
        }
    }

    /// Where a direction lands.
    pub fn apply(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        // 1 + a s + b s^2 + ...
        let series = |k: &[f64], s: f64| 1.0 + s * k.iter().rev().fold(0.0, |sum, k| sum * s + k);
        let squared = x * x + y * y;
        match self {
            Self::Perspective { numerator, denominator, tangential: [p1, p2] } => {
                let radial = series(numerator, squared) / series(denominator, squared);
                [
                    x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
                    y * radial + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y,
                ]
            }
            Self::Fisheye(k) => {
                let radius = squared.sqrt();
                if radius == 0.0 {
                    return [x, y];
                }
                let angle = radius.atan();
                let scale = angle * series(k, angle * angle) / radius;
                [x * scale, y * scale]
            }
        }
    }
}

impl Lens {
    /// The pinhole camera whose picture, as large as the photo, shows as much of it as fills the picture: the principal point is
    /// the lens's, the focal lengths are the lens's times one zoom.
    ///
    /// # Errors
    /// [`Error::Argument`] with `name` where there is none, for coefficients that are no lens's.
    pub fn pinhole(&self, name: &str) -> Result<Intrinsics> {
        let [mut low, mut high] = match self.distortion {
            Distortion::Perspective { .. } => ZOOM,
            Distortion::Fisheye(_) => FISHEYE_ZOOM,
        };
        if !self.fills(high) {
            let found = format!("{:?}", self.distortion);
            return Err(Error::argument(format!("{name}, lens distortion"), found, "coefficients of a lens"));
        }
        if self.fills(low) {
            return Ok(self.zoomed(low));
        }
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            *if self.fills(middle) { &mut high } else { &mut low } = middle;
        }
        Ok(self.zoomed(high))
    }

    /// The photo as the camera of [`Lens::pinhole`] would have taken it, of the photo's size; by cubic interpolation. The photo
    /// may have another resolution than the lens says.
    ///
    /// # Errors
    /// As [`Lens::pinhole`], and [`Error::Argument`] when the photo's fields disagree.
    pub fn undistort(&self, photo: &Image) -> Result<Image> {
        photo.validate()?;
        let (lens, pinhole) = (self.intrinsics, self.pinhole("photo")?);
        let [lens, pinhole] = [lens, pinhole].map(|intrinsics| intrinsics.resized(photo.width, photo.height));
        let mut rgb = vec![0; photo.rgb.len()];
        rgb.par_chunks_exact_mut(3 * photo.width as usize).enumerate().for_each(|(row, out)| {
            for (column, pixel) in out.chunks_exact_mut(3).enumerate() {
                let x = (column as f64 + 0.5 - pinhole.cx) / pinhole.fx;
                let y = (row as f64 + 0.5 - pinhole.cy) / pinhole.fy;
                let [x, y] = self.distortion.apply([x, y]);
                pixel.copy_from_slice(&sample(photo, lens.fx * x + lens.cx, lens.fy * y + lens.cy));
            }
        });
        Image::new(photo.width, photo.height, rgb)
    }

    fn zoomed(&self, zoom: f64) -> Intrinsics {
        let i = self.intrinsics;
        Intrinsics { fx: i.fx * zoom, fy: i.fy * zoom, ..i }
    }

    /// Whether the pinhole camera's picture at a zoom lies within the photo. Polynomials turn back far from the middle: a point
    /// counts only where the way to it leads outwards.
    fn fills(&self, zoom: f64) -> bool {
        let (i, pinhole) = (&self.intrinsics, self.zoomed(zoom));
        let (w, h) = (f64::from(i.width), f64::from(i.height));
        let border = (0..=SIDE_POINTS).map(|k| f64::from(k) / f64::from(SIDE_POINTS));
        let mut points = border.flat_map(|t| [[t * w, 0.0], [t * w, h], [0.0, t * h], [w, t * h]]);
        points.all(|[u, v]| {
            let [x, y] = [(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy];
            let mut before = 0.0;
            let outwards = (1..=STEPS).all(|step| {
                let t = f64::from(step) / f64::from(STEPS);
                let [dx, dy] = self.distortion.apply([t * x, t * y]);
                let distance = dx.hypot(dy);
                std::mem::replace(&mut before, distance) < distance
            });
            let [x, y] = self.distortion.apply([x, y]);
            let (u, v) = (i.fx * x + i.cx, i.fy * y + i.cy);
            outwards && (-EDGE..=w + EDGE).contains(&u) && (-EDGE..=h + EDGE).contains(&v)
        })
    }
}

/// Pixels by which a picture's border may leave the photo: rounding.
const EDGE: f64 = 1e-6;

/// A photo at a place in pixels, between its pixels by Catmull and Rom's cubic; beyond its border the nearest pixel.
fn sample(photo: &Image, x: f64, y: f64) -> [u8; 3] {
    let taps = |at: f64, count: u32| {
        let (first, t) = ((at - 0.5).floor(), (at - 0.5) - (at - 0.5).floor());
        let weights = [
            t * (-0.5 + t * (1.0 - 0.5 * t)),
            1.0 + t * t * (1.5 * t - 2.5),
            t * (0.5 + t * (2.0 - 1.5 * t)),
            t * t * (0.5 * t - 0.5),
        ];
        let place = |k: usize| (first + k as f64 - 1.0).clamp(0.0, f64::from(count - 1)) as usize;
        ([0, 1, 2, 3].map(place), weights)
    };
    let ((columns, across), (rows, down)) = (taps(x, photo.width), taps(y, photo.height));
    let mut sums = [0.0; 3];
    for (row, down) in rows.iter().zip(down) {
        for (column, across) in columns.iter().zip(across) {
            let at = 3 * (row * photo.width as usize + column);
            for (sum, value) in sums.iter_mut().zip(&photo.rgb[at..at + 3]) {
                *sum += down * across * f64::from(*value);
            }
        }
    }
    sums.map(|sum| sum.round().clamp(0.0, 255.0) as u8)
}
