//! Distorting lenses, and pinhole views of their photos.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{Image, Intrinsics, image::MAX_SIDE};
use crate::{Error, Result};

/// Widest field of view of a pinhole view, in degrees.
pub const MAX_VIEW_DEG: f64 = 110.0;
/// Field of view of the square views of a cut photo, in degrees.
pub const CUT_VIEW_DEG: f64 = 100.0;
/// Angle in degrees between the side views' far edges and the photo's edge, and the limits of
/// their turn.
const BEYOND_EDGE_DEG: f64 = 5.0;
const TURN_DEG: [f64; 2] = [30.0, 60.0];
/// Views around the horizon of a 360-degree photo.
const AROUND: u32 = 6;
/// Least radius of a fisheye's image circle, in degrees from the axis.
const CIRCLE_DEG: f64 = 85.0;
/// Resolution of a field of view, in degrees.
const STEP_DEG: f64 = 0.25;

/// The lower bound limits fisheye lenses.
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
    /// The shown view of [`Lens::views`].
    pub view: usize,
}

/// A pinhole view of a lens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LensView {
    /// Intrinsics at the original photo's resolution.
    pub intrinsics: Intrinsics,
    /// Rotation from the view's axes to the lens's.
    pub rotation: DMat3,
}

/// Distortion model: maps rays to distorted coordinates.
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
    /// Longitude and latitude of a 360-degree photo, centered on the axis.
    Equirectangular,
}

impl Distortion {
    /// Returns true if all coefficients are zero.
    pub fn is_none(&self) -> bool {
        match self {
            Self::Perspective { numerator, denominator, tangential } => {
                numerator.iter().chain(denominator).chain(tangential).all(|k| *k == 0.0)
            }
            Self::Fisheye(_) | Self::Equirectangular => false,
        }
    }

    /// Projects a ray, up to the intrinsics. Rays behind a perspective lens give NaN.
    pub fn project(&self, ray: DVec3) -> [f64; 2] {
        let series = |k: &[f64], s: f64| 1.0 + s * k.iter().rev().fold(0.0, |sum, k| sum * s + k);
        match self {
            Self::Perspective { .. } if ray.z <= 0.0 => [f64::NAN; 2],
            Self::Perspective { numerator, denominator, tangential: [p1, p2] } => {
                let [x, y] = [ray.x / ray.z, ray.y / ray.z];
                let squared = x * x + y * y;
                let radial = series(numerator, squared) / series(denominator, squared);
                [
                    x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x),
                    y * radial + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y,
                ]
            }
            Self::Fisheye(k) => {
                let radius = (ray.x * ray.x + ray.y * ray.y).sqrt();
                if radius == 0.0 {
                    return [ray.x, ray.y];
                }
                let angle = (radius / ray.z).atan() + if ray.z < 0.0 { PI } else { 0.0 };
                let scale = angle * series(k, angle * angle) / radius;
                [ray.x * scale, ray.y * scale]
            }
            Self::Equirectangular => [ray.x.atan2(ray.z), ray.y.atan2(ray.x.hypot(ray.z))],
        }
    }
}

impl Lens {
    /// Creates the lens of a 360-degree photo.
    ///
    /// # Errors
    /// [`Error::Argument`] with `name` for a photo that is not twice as wide as high.
    pub fn equirectangular(width: u32, height: u32, name: &str) -> Result<Self> {
        if u64::from(width) != 2 * u64::from(height) {
            let what = format!("size of {name}, an equirectangular photo");
            return Err(Error::argument(what, format!("{width}x{height}"), "twice as wide as high"));
        }
        let (w, h) = (f64::from(width), f64::from(height));
        let intrinsics = Intrinsics { width, height, fx: w / TAU, fy: h / PI, cx: w / 2.0, cy: h / 2.0 };
        Ok(Self { intrinsics, distortion: Distortion::Equirectangular, view: 0 })
    }

    /// Returns the pinhole views of the photo. The first looks along the axis.
    ///
    /// Lenses of up to [`MAX_VIEW_DEG`] across and down, and perspective lenses without a
    /// denominator, have one view of the photo's size: the widest that the photo fills, with its
    /// principal point and both focal lengths scaled alike. Wider photos are cut into overlapping
    /// squares of [`CUT_VIEW_DEG`].
    ///
    /// # Errors
    /// [`Error::Argument`] with `name` for coefficients without such a camera.
    pub fn views(&self, name: &str) -> Result<Vec<LensView>> {
        let turns = self.turns();
        let intrinsics = if turns.len() == 1 { self.whole(name)? } else { self.square() };
        Ok(turns.into_iter().map(|rotation| LensView { intrinsics, rotation }).collect())
    }

    /// Returns the pinhole intrinsics of the shown view.
    ///
    /// # Errors
    /// As [`Lens::views`].
    pub fn pinhole(&self, name: &str) -> Result<Intrinsics> {
        Ok(self.views(name)?[0].intrinsics)
    }

    /// Returns the rotation from the shown view's axes to the lens's.
    pub fn rotation(&self) -> DMat3 {
        self.turns().get(self.view).copied().unwrap_or_default()
    }

    /// Returns the number of views.
    pub fn view_count(&self) -> usize {
        self.turns().len()
    }

    /// Returns the size of the shown view's picture for a photo of this size.
    pub fn view_size(&self, photo: [u32; 2]) -> [u32; 2] {
        if self.view_count() == 1 {
            return photo;
        }
        let scale = f64::from(photo[0]) / f64::from(self.intrinsics.width);
        [((f64::from(self.square().width) * scale).round() as u32).clamp(1, MAX_SIDE); 2]
    }

    /// Makes the shown view's picture of a photo, at its resolution, by cubic interpolation. Masks
    /// pixels of cut fisheye photos outside the lens.
    pub fn undistort(&self, photo: &Image) -> Result<Image> {
        photo.validate()?;
        let size = [photo.width, photo.height];
        let ([width, height], place) = (self.view_size(size), self.places(size)?);
        let wraps = self.distortion == Distortion::Equirectangular;
        let columns = width as usize;
        let mut rgb = vec![0; 3 * columns * height as usize];
        rgb.par_chunks_exact_mut(3 * columns).enumerate().for_each(|(row, out)| {
            for (column, pixel) in out.chunks_exact_mut(3).enumerate() {
                let (x, y) = place(row, column);
                pixel.copy_from_slice(&sample(photo, x, y, wraps));
            }
        });
        let is_partial = !wraps && self.view_count() > 1;
        let mask_at = |at: usize| {
            let (x, y) = place(at / columns, at % columns);
            let is_shown =
                !is_partial || (0.0..=f64::from(size[0])).contains(&x) && (0.0..=f64::from(size[1])).contains(&y);
            let kept = photo.mask.as_ref().map_or(u8::MAX, |mask| Image::mask_around(mask, size, x, y));
            if is_shown { kept } else { 0 }
        };
        let is_masked = photo.mask.is_some() || is_partial;
        let mask = is_masked.then(|| (0..columns * height as usize).map(mask_at).collect());
        Ok(Image { width, height, rgb, mask })
    }

    /// Maps rows and columns of the shown view's picture to a photo of this size; NaN outside a cut
    /// photo.
    ///
    /// # Errors
    /// As [`Lens::views`].
    pub fn places(&self, photo: [u32; 2]) -> Result<impl Fn(usize, usize) -> (f64, f64) + Sync> {
        let views = self.views("photo")?;
        let LensView { intrinsics, rotation } = views[self.view.min(views.len() - 1)];
        let [width, height] = if views.len() == 1 { photo } else { self.view_size(photo) };
        let (lens, pinhole) = (self.intrinsics.resized(photo[0], photo[1]), intrinsics.resized(width, height));
        let shows_all = views.len() == 1 || self.distortion == Distortion::Equirectangular;
        let reach = if shows_all { -1.0 } else { self.field().reach.cos() };
        Ok(move |row: usize, column: usize| {
            let x = (column as f64 + 0.5 - pinhole.cx) / pinhole.fx;
            let y = (row as f64 + 0.5 - pinhole.cy) / pinhole.fy;
            let ray = rotation * DVec3::new(x, y, 1.0);
            if ray.z < reach * ray.length() {
                return (f64::NAN, f64::NAN);
            }
            let [x, y] = self.distortion.project(ray);
            (lens.fx * x + lens.cx, lens.fy * y + lens.cy)
        })
    }

    fn whole(&self, name: &str) -> Result<Intrinsics> {
        let [mut low, mut high] = match self.distortion {
            Distortion::Fisheye(_) => FISHEYE_ZOOM,
            Distortion::Perspective { .. } | Distortion::Equirectangular => ZOOM,
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

    fn square(&self) -> Intrinsics {
        let (i, half) = (&self.intrinsics, (CUT_VIEW_DEG / 2.0).to_radians().tan());
        let most = f64::from(i.width.max(i.height).saturating_mul(2).min(MAX_SIDE));
        let side = (2.0 * i.fx * half).round().clamp(1.0, most);
        let (focal, middle) = (side / 2.0 / half, side / 2.0);
        Intrinsics { width: side as u32, height: side as u32, fx: focal, fy: focal, cx: middle, cy: middle }
    }

    fn turns(&self) -> Vec<DMat3> {
        if self.distortion == Distortion::Equirectangular {
            let around = (0..AROUND).map(|k| DMat3::from_rotation_y(TAU * f64::from(k) / f64::from(AROUND)));
            return around.chain([FRAC_PI_2, -FRAC_PI_2].map(DMat3::from_rotation_x)).collect();
        }
        if matches!(self.distortion, Distortion::Perspective { denominator: [0.0, 0.0, 0.0], .. }) {
            return vec![DMat3::IDENTITY];
        }
        let Field { across, down, .. } = self.field();
        let turn = |angle: f64| {
            let toward_edge = angle.to_degrees() + BEYOND_EDGE_DEG - CUT_VIEW_DEG / 2.0;
            toward_edge.clamp(TURN_DEG[0], TURN_DEG[1]).to_radians()
        };
        let mut turns = vec![DMat3::IDENTITY];
        for (angle, rotation) in [(across, DMat3::from_rotation_y as fn(f64) -> DMat3), (down, DMat3::from_rotation_x)]
        {
            if 2.0 * angle.to_degrees() > MAX_VIEW_DEG {
                turns.extend([-turn(angle), turn(angle)].map(rotation));
            }
        }
        turns
    }

    fn field(&self) -> Field {
        let i = &self.intrinsics;
        let [left, right] = [0.0, f64::from(i.width)].map(|u| (u - i.cx) / i.fx);
        let [top, bottom] = [0.0, f64::from(i.height)].map(|v| (v - i.cy) / i.fy);
        let widest = |edges: &[[f64; 2]]| edges.iter().map(|edge| self.extent(*edge)).fold(0.0, f64::max);
        let (across, down) = (widest(&[[left, 0.0], [right, 0.0]]), widest(&[[0.0, top], [0.0, bottom]]));
        let corner = widest(&[[left, top], [right, top], [left, bottom], [right, bottom]]);
        // Beyond half the world, the photo's corners are outside the image circle.
        let mut radii = [across, down, corner];
        radii.sort_by(f64::total_cmp);
        let reach = radii.into_iter().find(|radius| radius.to_degrees() >= CIRCLE_DEG).unwrap_or(radii[2]);
        Field { across: across.min(reach), down: down.min(reach), reach }
    }

    /// Returns the angle from the axis to the photo's edge, or to where the polynomial folds back.
    fn extent(&self, direction: [f64; 2]) -> f64 {
        let length = direction[0].hypot(direction[1]);
        let (i, mut before) = (&self.intrinsics, 0.0);
        let is_shown = |step: &u32| {
            let (sin, cos) = (STEP_DEG * f64::from(*step)).to_radians().sin_cos();
            let [x, y] = direction.map(|d| sin * d / length);
            let [x, y] = self.distortion.project(DVec3::new(x, y, cos));
            let (u, v, distance) = (i.fx * x + i.cx, i.fy * y + i.cy, x.hypot(y));
            std::mem::replace(&mut before, distance) < distance
                && (-EDGE..=f64::from(i.width) + EDGE).contains(&u)
                && (-EDGE..=f64::from(i.height) + EDGE).contains(&v)
        };
        let steps = (1..(180.0 / STEP_DEG) as u32).take_while(is_shown).count();
        (STEP_DEG * steps as f64).to_radians()
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
                let [dx, dy] = self.distortion.project(DVec3::new(t * x, t * y, 1.0));
                let distance = dx.hypot(dy);
                std::mem::replace(&mut before, distance) < distance
            });
            let [x, y] = self.distortion.project(DVec3::new(x, y, 1.0));
            let (u, v) = (i.fx * x + i.cx, i.fy * y + i.cy);
            outwards && (-EDGE..=w + EDGE).contains(&u) && (-EDGE..=h + EDGE).contains(&v)
        })
    }
}

/// Angles from the axis that a photo shows.
struct Field {
    across: f64,
    down: f64,
    /// Radius of the image circle.
    reach: f64,
}

/// Rounding tolerance at the photo's border, in pixels.
const EDGE: f64 = 1e-6;

/// `wraps` joins the left and right edges.
fn sample(photo: &Image, x: f64, y: f64, wraps: bool) -> [u8; 3] {
    let taps = |at: f64, count: u32, wraps: bool| {
        let (first, t) = ((at - 0.5).floor(), (at - 0.5) - (at - 0.5).floor());
        let weights = [
            t * (-0.5 + t * (1.0 - 0.5 * t)),
            1.0 + t * t * (1.5 * t - 2.5),
            t * (0.5 + t * (2.0 - 1.5 * t)),
            t * t * (0.5 * t - 0.5),
        ];
        let place = |k: usize| {
            let (tap, last) = (first + k as f64 - 1.0, f64::from(count - 1));
            let tap = if wraps { tap.rem_euclid(f64::from(count)) } else { tap };
            tap.clamp(0.0, last) as usize
        };
        ([0, 1, 2, 3].map(place), weights)
    };
    let ((columns, across), (rows, down)) = (taps(x, photo.width, wraps), taps(y, photo.height, false));
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
