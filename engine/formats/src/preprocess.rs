//! Photo preprocessing for the network, bit-identical to the reference.

use super::resample::resize_lanczos;
use super::{Camera, Image, Intrinsics};
use crate::{Error, Result};

/// Patch side, which divides the input's sides.
pub const PATCH: u32 = 14;
/// Input side of the released model's training.
pub const DEFAULT_SIZE: u32 = 252;

/// A photo resized for the network.
#[derive(Clone, Debug)]
pub struct View {
    /// Network input.
    pub image: Image,
    /// Map from photo pixels to `image` pixels.
    pub map: PixelMap,
}

/// Pixel map of a crop and resize: `new = scale * old + offset` for x and y, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelMap {
    /// Photo size, `[width, height]`.
    pub from: [u32; 2],
    /// Result size, `[width, height]`.
    pub to: [u32; 2],
    /// Result pixels per photo pixel.
    pub scale: [f64; 2],
    /// Result position of the photo's top left corner.
    pub offset: [f64; 2],
}

impl PixelMap {
    /// Returns the map of [`cropped`], from and to sizes `[width, height]`.
    pub fn cropped(from: [u32; 2], to: [u32; 2]) -> Self {
        let rect = crop_to_aspect(from[0], from[1], f64::from(to[0]) / f64::from(to[1]));
        let scale = [f64::from(to[0]) / f64::from(rect.width), f64::from(to[1]) / f64::from(rect.height)];
        let offset = [-f64::from(rect.left) * scale[0], -f64::from(rect.top) * scale[1]];
        Self { from, to, scale, offset }
    }

    /// Returns the identity map of a photo.
    pub fn identity(photo: &Image) -> Self {
        Self::resized([photo.width, photo.height], [photo.width, photo.height])
    }

    /// Returns the map of a whole photo, from and to sizes `[width, height]`.
    pub fn resized(from: [u32; 2], to: [u32; 2]) -> Self {
        let scale = [0, 1].map(|axis| f64::from(to[axis]) / f64::from(from[axis]));
        Self { from, to, scale, offset: [0.0; 2] }
    }

    /// Maps intrinsics of the photo, in any resolution, to the result.
    ///
    /// # Errors
    /// [`Error::Argument`] with `label` if the aspect ratios differ by more than 1 %.
    pub fn apply(&self, intrinsics: &Intrinsics, label: &str) -> Result<Intrinsics> {
        let [width, height] = self.from;
        let stretch =
            f64::from(intrinsics.width) * f64::from(height) / (f64::from(intrinsics.height) * f64::from(width));
        let alike = (stretch - 1.0).abs() < 0.01;
        if !alike {
            let found = format!("{}x{}", intrinsics.width, intrinsics.height);
            let expected = format!("the aspect ratio of its photo, {width}x{height}");
            return Err(Error::argument(format!("size of {label}"), found, expected));
        }
        let photo = intrinsics.resized(width, height);
        let ([sx, sy], [x, y]) = (self.scale, self.offset);
        Ok(Intrinsics {
            width: self.to[0],
            height: self.to[1],
            fx: photo.fx * sx,
            fy: photo.fy * sy,
            cx: photo.cx * sx + x,
            cy: photo.cy * sy + y,
        })
    }

    /// Maps a camera of the photo, in any resolution, to the result, as [`PixelMap::apply`].
    pub fn camera(&self, camera: &Camera, label: &str) -> Result<Camera> {
        camera.validate(label)?;
        Ok(Camera { intrinsics: self.apply(&camera.intrinsics, label)?, ..*camera })
    }

    /// Maps intrinsics of the result to the photo.
    pub fn undo(&self, result: &Intrinsics) -> Intrinsics {
        let ([width, height], [sx, sy], [x, y]) = (self.from, self.scale, self.offset);
        let (cx, cy) = ((result.cx - x) / sx, (result.cy - y) / sy);
        Intrinsics { width, height, fx: result.fx / sx, fy: result.fy / sy, cx, cy }
    }
}

/// Maps cameras of whole photos to views, relative to the first view's camera.
pub fn view_cameras(cameras: &[Camera], views: &[View]) -> Result<Vec<Camera>> {
    let of_view = |(i, (camera, view)): (usize, (&Camera, &View))| {
        Ok(view.map.camera(camera, &format!("camera {i}"))?.relative_to(&cameras[0].pose))
    };
    cameras.iter().zip(views).enumerate().map(of_view).collect()
}

/// Crops the center to the aspect ratio of `width` x `height`, and resizes by Pillow's LANCZOS.
///
/// # Errors
/// [`Error::Argument`] if a side is not a positive multiple of [`PATCH`].
pub fn fit(photo: &Image, width: u32, height: u32) -> Result<View> {
    check_size(width, height)?;
    cropped(photo, width, height)
}

/// As [`fit`], to any size but zero.
pub fn cropped(photo: &Image, width: u32, height: u32) -> Result<View> {
    photo.validate()?;
    let rect = crop_to_aspect(photo.width, photo.height, f64::from(width) / f64::from(height));
    let crop = photo.crop(rect.left, rect.top, rect.width, rect.height)?;
    let image = resize_lanczos(&crop, width, height)?;
    Ok(View { image, map: PixelMap::cropped([photo.width, photo.height], [width, height]) })
}

/// Resizes a whole photo by the scale of [`cropped`].
pub fn whole(photo: &Image, width: u32, height: u32) -> Result<View> {
    photo.validate()?;
    let scale = (f64::from(width) / f64::from(photo.width)).max(f64::from(height) / f64::from(photo.height));
    let from = [photo.width, photo.height];
    let to = from.map(|length| (f64::from(length) * scale).round() as u32);
    Ok(View { image: resize_lanczos(photo, to[0], to[1])?, map: PixelMap::resized(from, to) })
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rect {
    /// Left column.
    pub left: u32,
    /// Top row.
    pub top: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Returns the largest centered rectangle of an aspect ratio, sides rounded half to even.
pub fn crop_to_aspect(width: u32, height: u32, aspect: f64) -> Rect {
    let round = |side: f64, most: u32| (side.round_ties_even() as u32).clamp(1, most);
    let wanted = (f64::from(height) * aspect).round_ties_even();
    let (w, h) = if wanted <= f64::from(width) {
        (round(wanted, width), height)
    } else {
        (width, round(f64::from(width) / aspect, height))
    };
    Rect { left: (width - w) / 2, top: (height - h) / 2, width: w, height: h }
}

fn check_size(width: u32, height: u32) -> Result<()> {
    if width == 0 || height == 0 || !width.is_multiple_of(PATCH) || !height.is_multiple_of(PATCH) {
        let expected = format!("positive multiples of {PATCH}");
        return Err(Error::argument("input size", format!("{width}x{height}"), expected));
    }
    Ok(())
}
