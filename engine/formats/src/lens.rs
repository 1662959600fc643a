use rayon::prelude::*;

use super::{Image, Intrinsics};
use crate::{Error, Result};

/// The lower bound limits fisheye lenses, which may see half the world.
const ZOOM: [f64; 2] = [0.7, 4.0];
const FISHEYE_ZOOM: [f64; 2] = [1.0, 4.0];
const HALVINGS: usize = 40;
const SIDE_POINTS: u32 = 16;
const STEPS: u32 = 8;

/// A lens with distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Intrinsics of the original photo, in pixels.
    pub intrinsics: Intrinsics,
    /// Distortion before the intrinsics.
    pub distortion: Distortion,
}

/// Distortion model: maps the direction `(x, y, 1)` to distorted coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// OpenCV's rational model with `r² = x² + y²`: a radial quotient of polynomials in r², plus
    /// tangential terms.
    Perspective {
        /// k1, k2, k3 and the coefficient of r⁸: numerator `1 + k1 r² + k2 r⁴ + ...`.
        numerator: [f64; 4],
        /// OpenCV's k4, k5 and k6: denominator `1 + k4 r² + ...`.
        denominator: [f64; 3],
        /// p1 and p2.
        tangential: [f64; 2],
    },
    /// OpenCV's fisheye model: radius `t (1 + k1 t² + k2 t⁴ + ...)` for angle t from the axis.
    Fisheye([f64; 4]),
}

impl Distortion {
    /// Returns true if all coefficients are zero.
    pub fn is_none(&self) -> bool {
        match self {
            Self::Perspective { numerator, denominator, tangential } => {
                numerator.iter().chain(denominator).chain(tangential).all(|k| *k == 0.0)
            }
            Self::Fisheye(_) => false,
        }
    }

    /// Distorts a direction.
    pub fn apply(&self, [x, y]: [f64; 2]) -> [f64; 2] {
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
    /// Returns the pinhole camera of the photo's size with the widest view that the photo fills.
    /// Keeps the principal point and scales both focal lengths by one zoom.
    ///
    /// # Errors
    /// [`Error::Argument`] with `name` for coefficients without such a camera.
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

    /// Undistorts a photo to [`Lens::pinhole`] at the photo's own resolution, by cubic
    /// interpolation.
    pub fn undistort(&self, photo: &Image) -> Result<Image> {
        photo.validate()?;
        let place = self.places([photo.width, photo.height])?;
        let (width, size) = (photo.width as usize, [photo.width, photo.height]);
        let mut rgb = vec![0; photo.rgb.len()];
        rgb.par_chunks_exact_mut(3 * width).enumerate().for_each(|(row, out)| {
            for (column, pixel) in out.chunks_exact_mut(3).enumerate() {
                let (x, y) = place(row, column);
                pixel.copy_from_slice(&sample(photo, x, y));
            }
        });
        let mask_at = |mask: &[u8], at: usize| {
            let (x, y) = place(at / width, at % width);
            Image::mask_around(mask, size, x, y)
        };
        let mask = photo.mask.as_ref().map(|mask| (0..mask.len()).map(|at| mask_at(mask, at)).collect());
        Ok(Image { width: photo.width, height: photo.height, rgb, mask })
    }

    /// Returns the place in a photo of this size of each row and column of its [`Lens::pinhole`]
    /// picture.
    ///
    /// # Errors
    /// As [`Lens::pinhole`].
    pub fn places(&self, [width, height]: [u32; 2]) -> Result<impl Fn(usize, usize) -> (f64, f64) + Sync> {
        let [lens, pinhole] =
            [self.intrinsics, self.pinhole("photo")?].map(|intrinsics| intrinsics.resized(width, height));
        Ok(move |row: usize, column: usize| {
            let x = (column as f64 + 0.5 - pinhole.cx) / pinhole.fx;
            let y = (row as f64 + 0.5 - pinhole.cy) / pinhole.fy;
            let [x, y] = self.distortion.apply([x, y]);
            (lens.fx * x + lens.cx, lens.fy * y + lens.cy)
        })
    }

    fn zoomed(&self, zoom: f64) -> Intrinsics {
        let i = self.intrinsics;
        Intrinsics { fx: i.fx * zoom, fy: i.fy * zoom, ..i }
    }

    /// Polynomials fold back far from the center, so radii must grow toward each border point.
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

/// Rounding tolerance at the photo's border, in pixels.
const EDGE: f64 = 1e-6;

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
