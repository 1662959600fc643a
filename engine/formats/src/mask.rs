//! Masks of photos: pixels to ignore.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

use image::{DynamicImage, GrayImage};

use super::image::{Image, decode, into_rgb};
use super::resample::window;
use crate::{Error, Result};

/// Value of masked pixels in both pictures of a comparison.
pub const MASKED: u8 = 128;
const KEPT: u8 = 255;

/// Source of photos' masks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Masks {
    /// Pixel values; 0 ignores a pixel.
    pub source: MaskSource,
    /// Whether 0 keeps a pixel, and other values ignore it.
    pub inverted: bool,
}

/// Pixel values of [`Masks`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MaskSource {
    /// A folder of PNGs of the photos' sizes, without EXIF orientation, named by [`named_after`].
    Folder(PathBuf),
    /// Alpha channels of the photos.
    Alpha,
}

/// Returns a photo's companions in a folder: for `1.jpg`, `1.jpg.png` (as COLMAP) or `1.png`.
pub fn named_after(folder: &Path, photo: &Path, extension: &str) -> [PathBuf; 2] {
    [photo.file_name(), photo.file_stem()].map(|name| {
        let mut name = name.unwrap_or_default().to_owned();
        name.push(format!(".{extension}"));
        folder.join(name)
    })
}

impl Masks {
    /// Returns the file of a photo's mask, or the photo itself for its alpha channel.
    ///
    /// # Errors
    /// [`Error::Argument`] if the folder has none.
    pub fn file(&self, photo: &Path) -> Result<PathBuf> {
        let MaskSource::Folder(folder) = &self.source else { return Ok(photo.to_owned()) };
        let files = named_after(folder, photo, "png");
        files.iter().find(|file| file.is_file() && *file != photo).cloned().ok_or_else(|| {
            let expected = format!("{} or {}", files[1].display(), files[0].display());
            Error::argument(format!("mask of {}", photo.display()), "none", expected)
        })
    }

    /// Checks that each photo has a mask of its own, of its size.
    ///
    /// # Errors
    /// [`Error::Argument`] with the names of a photo and its mask.
    pub fn check(&self, photos: &[impl AsRef<Path>]) -> Result<()> {
        let mut photo_of: HashMap<PathBuf, &Path> = HashMap::new();
        for photo in photos.iter().map(AsRef::as_ref) {
            let file = self.file(photo)?;
            check_size(photo, Image::size_as_stored(photo)?, &file, Image::size_as_stored(&file)?)?;
            if let Some(other) = photo_of.insert(file.clone(), photo).filter(|other| *other != photo) {
                let found = format!("{}, as of {}", file.display(), other.display());
                return Err(Error::argument(format!("mask of {}", photo.display()), found, "one of its own"));
            }
        }
        Ok(())
    }

    /// Opens a photo with its mask, as [`Image::open_as_stored`] or [`Image::open`].
    ///
    /// # Errors
    /// Those of [`Masks::check`]; [`Error::Argument`] for a mask that keeps no pixel.
    pub fn open(&self, path: impl AsRef<Path>, as_stored: bool) -> Result<Image> {
        let path = path.as_ref();
        let (mut photo, orientation) = decode(path)?;
        let (width, height) = (photo.width(), photo.height());
        let (file, is_zero) = (self.file(path)?, |values: &[u8]| values.iter().all(|value| *value == 0));
        let ignored: Vec<bool> = match self.source {
            MaskSource::Folder(_) => {
                let mask = decode(&file)?.0;
                check_size(path, (width, height), &file, (mask.width(), mask.height()))?;
                into_rgb(mask).chunks_exact(3).map(is_zero).collect()
            }
            MaskSource::Alpha if !photo.color().has_alpha() => {
                let expected = "an alpha channel, or a folder of masks";
                return Err(Error::argument(format!("mask of {}", path.display()), "no alpha channel", expected));
            }
            MaskSource::Alpha => photo.to_luma_alpha8().chunks_exact(2).map(|pixel| is_zero(&pixel[1..])).collect(),
        };
        let mask: Vec<u8> = ignored.iter().map(|ignored| if *ignored == self.inverted { KEPT } else { 0 }).collect();
        if is_zero(&mask) {
            let expected = "some; inverted masks have 0 there";
            return Err(Error::argument(format!("kept pixels of the mask {}", file.display()), "none", expected));
        }
        let mask = GrayImage::from_raw(width, height, mask).expect("a byte per pixel");
        let mut mask = DynamicImage::ImageLuma8(mask);
        if !as_stored {
            photo.apply_orientation(orientation);
            mask.apply_orientation(orientation);
        }
        Image::new(photo.width(), photo.height(), into_rgb(photo))?.with_mask(mask.into_bytes())
    }
}

fn check_size(photo: &Path, size: (u32, u32), mask: &Path, found: (u32, u32)) -> Result<()> {
    if found == size {
        return Ok(());
    }
    let expected = format!("{}x{}, as {} is stored", size.0, size.1, photo.display());
    Err(Error::argument(format!("size of the mask {}", mask.display()), format!("{}x{}", found.0, found.1), expected))
}

impl Image {
    /// Adds a mask, `[height][width]`: pixels of 0 are ignored.
    pub fn with_mask(self, mask: Vec<u8>) -> Result<Self> {
        let image = Self { mask: Some(mask), ..self };
        image.validate()?;
        Ok(image)
    }

    /// Returns the mask, or one that keeps all pixels.
    pub fn mask_or_all(&self) -> Cow<'_, [u8]> {
        let all = || Cow::Owned(vec![KEPT; self.width as usize * self.height as usize]);
        self.mask.as_deref().map_or_else(all, Cow::Borrowed)
    }

    /// Returns whether the mask ignores pixel `at` of `[height][width]`.
    pub fn ignores(&self, at: usize) -> bool {
        self.mask.as_ref().is_some_and(|mask| mask[at] == 0)
    }

    /// Returns a picture's values, `[height][width][rgb]`, at kept pixels.
    pub fn kept<'a, T: Copy>(&self, values: &'a [T]) -> Cow<'a, [T]>
    where
        [T]: ToOwned<Owned = Vec<T>>,
    {
        let Some(mask) = &self.mask else { return Cow::Borrowed(values) };
        let pixels = values.chunks_exact(3).zip(mask).filter(|(_, kept)| **kept != 0);
        Cow::Owned(pixels.flat_map(|(pixel, _)| pixel).copied().collect())
    }

    /// Sets a picture's values, `[height][width][rgb]`, at ignored pixels.
    pub fn hide<T: Copy>(&self, values: &mut [T], value: T) {
        let Some(mask) = &self.mask else { return };
        let hidden = values.chunks_exact_mut(3).zip(mask).filter(|(_, kept)| **kept == 0);
        hidden.for_each(|(pixel, _)| pixel.fill(value));
    }

    /// Returns the image with gray masked pixels.
    pub fn hidden(&self) -> Cow<'_, Self> {
        if self.mask.is_none() {
            return Cow::Borrowed(self);
        }
        let mut rgb = self.rgb.clone();
        self.hide(&mut rgb, MASKED);
        Cow::Owned(Self { rgb, mask: self.mask.clone(), ..*self })
    }

    /// Returns 0 if the mask ignores any of the four pixels around a position in pixels.
    pub(super) fn mask_around(mask: &[u8], [width, height]: [u32; 2], x: f64, y: f64) -> u8 {
        let pair = |at: f64, count: u32| {
            [0.0, 1.0].map(|k| ((at - 0.5).floor() + k).clamp(0.0, f64::from(count - 1)) as usize)
        };
        let (columns, rows) = (pair(x, width), pair(y, height));
        let places = rows.iter().flat_map(|row| columns.map(|column| row * width as usize + column));
        places.map(|at| mask[at]).min().unwrap_or(0)
    }

    /// Returns the resized mask: keeps pixels whose filter's central lobe is kept.
    pub(super) fn resized_mask(&self, [width, height]: [u32; 2]) -> Option<Vec<u8>> {
        let mask = self.mask.as_ref()?;
        let lobes = |inputs: u32, outputs: u32| {
            let scale = f64::from(inputs) / f64::from(outputs);
            let reach = if inputs == outputs { 0.5 } else { scale.max(1.0) };
            let center = move |output: u32| (f64::from(output) + 0.5) * scale;
            (0..outputs).map(move |output| window(center(output) - reach, center(output) + reach, inputs))
        };
        let least = |values: &mut dyn Iterator<Item = u8>| values.min().unwrap_or(0);
        let wide: Vec<u8> = mask
            .chunks_exact(self.width as usize)
            .flat_map(|row| lobes(self.width, width).map(|lobe| least(&mut row[lobe].iter().copied())))
            .collect();
        let at = |row: usize, column: usize| wide[row * width as usize + column];
        let rows =
            lobes(self.height, height).flat_map(|lobe| (0..width as usize).map(move |column| (lobe.clone(), column)));
        Some(rows.map(|(lobe, column)| least(&mut lobe.map(|row| at(row, column)))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preprocess::fit;
    use crate::resample::resize_lanczos;

    #[test]
    fn masks_follow_their_image() {
        let mut mask = vec![255; 56 * 28];
        mask[10 * 56 + 20] = 0;
        let image = Image::new(56, 28, vec![9; 3 * 56 * 28]).unwrap().with_mask(mask.clone()).unwrap();
        let hidden = |image: &Image| (0..image.rgb.len() / 3).filter(|at| image.ignores(*at)).collect::<Vec<_>>();
        assert_eq!(hidden(&resize_lanczos(&image, 56, 28).unwrap()), [10 * 56 + 20]);
        // Half the size: the pixel at (10, 5), and those whose central lobe reaches it.
        assert_eq!(
            hidden(&resize_lanczos(&image, 28, 14).unwrap()),
            [4 * 28 + 9, 4 * 28 + 10, 5 * 28 + 9, 5 * 28 + 10]
        );
        assert_eq!(hidden(&image.crop(20, 10, 2, 1).unwrap()), [0]);
        assert_eq!(hidden(&fit(&image, 28, 28).unwrap().image), [10 * 28 + 6]);
        assert_eq!(image.kept(&image.rgb).len(), 3 * (56 * 28 - 1));
        let gray = image.hidden();
        assert_eq!(
            (gray.rgb[3 * 580], gray.rgb[0], gray.rgb.iter().filter(|value| **value == MASKED).count()),
            (128, 9, 3)
        );
        assert!(Image::new(2, 2, vec![0; 12]).unwrap().with_mask(vec![0; 3]).is_err());
    }
}
