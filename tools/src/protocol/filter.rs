//! Downscaling filters of compared photos; the choice affects PSNR (table 6 of the paper).

use clap::ValueEnum;
use image::{ImageBuffer, Rgb, imageops};
use zipsplat::{
    Error, Result,
    types::{
        Image,
        preprocess::{PixelMap, View, cropped, whole},
    },
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Filter {
    /// Pillow's LANCZOS after the crop, as in every other command
    Lanczos,
    /// Bilinear with antialiasing before the crop, as in the paper's tables (PyTorch's interpolate)
    Bilinear,
}

impl Filter {
    /// Center-crops a photo to an aspect ratio and resizes it.
    pub fn cropped(self, photo: &Image, width: u32, height: u32) -> Result<View> {
        match self {
            Self::Lanczos => cropped(photo, width, height),
            Self::Bilinear => middle(cover(photo, width, height)?, width, height),
        }
    }

    /// Resizes a whole photo at the scale of [`Filter::cropped`].
    pub fn whole(self, photo: &Image, width: u32, height: u32) -> Result<View> {
        match self {
            Self::Lanczos => whole(photo, width, height),
            Self::Bilinear => cover(photo, width, height),
        }
    }
}

/// Like the reference, rounds sides to even and truncates values.
fn cover(photo: &Image, width: u32, height: u32) -> Result<View> {
    photo.validate()?;
    if width == 0 || height == 0 {
        return Err(Error::argument("image size", format!("{width}x{height}"), "at least 1 pixel on each side"));
    }
    let scale = (f64::from(width) / f64::from(photo.width)).max(f64::from(height) / f64::from(photo.height));
    let even = |side: u32, least: u32| (2 * (f64::from(side) * scale / 2.0).round_ties_even() as u32).max(least);
    let (to_width, to_height) = (even(photo.width, width), even(photo.height, height));
    let map = PixelMap::resized([photo.width, photo.height], [to_width, to_height]);
    if [to_width, to_height] == [photo.width, photo.height] {
        return Ok(View { image: photo.clone(), map });
    }
    let values: Vec<f32> = photo.rgb.iter().map(|value| f32::from(*value) / 255.0).collect();
    let pixels: ImageBuffer<Rgb<f32>, _> =
        ImageBuffer::from_raw(photo.width, photo.height, values).expect("a valid picture has all its pixels");
    let resized = imageops::resize(&pixels, to_width, to_height, imageops::FilterType::Triangle);
    let rgb = resized.into_raw().into_iter().map(|value| (value * 255.0) as u8).collect();
    Ok(View { image: Image::new(to_width, to_height, rgb)?, map })
}

fn middle(view: View, width: u32, height: u32) -> Result<View> {
    let View { image, map } = view;
    let (left, top) = ((image.width - width) / 2, (image.height - height) / 2);
    let offset = [map.offset[0] - f64::from(left), map.offset[1] - f64::from(top)];
    Ok(View { image: image.crop(left, top, width, height)?, map: PixelMap { to: [width, height], offset, ..map } })
}
