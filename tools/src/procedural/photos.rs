use std::{io::BufReader, path::Path};

use glam::{Vec2, Vec3A};
use rayon::prelude::*;
use serde::Deserialize;
use zipsplat::{
    Error, Result,
    types::{Image, open_file},
};

use super::tone::srgb_to_linear;

/// Class whose crops may color training data and releases.
const PERMISSIVE: &str = "permissive";

/// Entry of `manifest.json`; other fields are ignored.
#[derive(Clone, Debug, Deserialize)]
pub struct Crop {
    pub file: String,
    pub repo: String,
    #[serde(alias = "licence")]
    pub license: String,
    /// License class; only `permissive` crops are used.
    #[serde(alias = "licence_class")]
    pub license_class: String,
}

#[derive(Default)]
pub struct Photos {
    pub crops: Vec<Crop>,
    pyramids: Vec<Vec<Level>>,
}

struct Level {
    side: usize,
    rgb: Vec<[u8; 3]>,
}

impl Photos {
    /// Reads the permissively licensed crops of a folder's `manifest.json`.
    pub fn open(folder: &Path) -> Result<Self> {
        let manifest = folder.join("manifest.json");
        let file = BufReader::new(open_file(&manifest)?);
        let mut crops: Vec<Crop> =
            serde_json::from_reader(file).map_err(|error| Error::format(&manifest, None, error.to_string()))?;
        crops.retain(|crop| crop.license_class == PERMISSIVE);
        if crops.is_empty() {
            return Err(Error::format(&manifest, None, format!("found no crop of license_class {PERMISSIVE}")));
        }
        let read = |crop: &Crop| {
            let path = folder.join(&crop.file);
            let image = Image::open(&path)?;
            if image.width != image.height {
                return Err(Error::format(&path, None, format!("found {image:?}, expected a square")));
            }
            Ok(pyramid(&image))
        };
        let pyramids = crops.par_iter().map(read).collect::<Vec<_>>().into_iter().collect::<Result<_>>()?;
        Ok(Self { crops, pyramids })
    }

    /// Linear RGB over the mirrored unit square, with footprint `width`.
    pub(super) fn sample(&self, photo: usize, uv: Vec2, width: f32) -> Vec3A {
        let levels = &self.pyramids[photo];
        let level = (width * levels[0].side as f32).max(1.0).log2().min((levels.len() - 1) as f32);
        let fine = levels[level as usize].sample(uv);
        let rest = level.fract();
        if rest < 0.05 {
            return srgb_to_linear(fine);
        }
        srgb_to_linear(fine.lerp(levels[level as usize + 1].sample(uv), rest))
    }

    /// Along the normal's nearest axes.
    pub(super) fn sample_projected(&self, photo: usize, p: Vec3A, normal: Vec3A, width: f32) -> Vec3A {
        let weights = (normal.abs() - 0.45).max(Vec3A::ZERO);
        let weights = weights / weights.element_sum();
        let sides =
            [(weights.x, Vec2::new(p.y, -p.z)), (weights.y, Vec2::new(p.x, -p.z)), (weights.z, Vec2::new(p.x, p.y))];
        let seen = sides.into_iter().filter(|(weight, _)| *weight > 0.0);
        seen.map(|(weight, uv)| weight * self.sample(photo, uv, width)).sum()
    }
}

fn pyramid(image: &Image) -> Vec<Level> {
    let rgb = image.rgb.chunks_exact(3).map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let mut levels = vec![Level { side: image.width as usize, rgb }];
    while let Some(level) = levels.last().filter(|level| level.side > 1) {
        levels.push(level.halved());
    }
    levels
}

impl Level {
    fn halved(&self) -> Self {
        let side = self.side / 2;
        let pixel = |i: usize| {
            let at = 2 * (i / side) * self.side + 2 * (i % side);
            let block = [at, at + 1, at + self.side, at + self.side + 1].map(|k| self.rgb[k]);
            [0, 1, 2].map(|c| (block.iter().map(|rgb| u32::from(rgb[c])).sum::<u32>() / 4) as u8)
        };
        Self { side, rgb: (0..side * side).map(pixel).collect() }
    }

    /// sRGB in 0..1.
    fn sample(&self, uv: Vec2) -> Vec3A {
        let last = self.side - 1;
        let fold = |x: f32| 1.0 - (x.rem_euclid(2.0) - 1.0).abs();
        let at = (Vec2::new(fold(uv.x), fold(uv.y)) * self.side as f32 - 0.5).max(Vec2::ZERO);
        let (x, y) = ((at.x as usize).min(last), (at.y as usize).min(last));
        let (x1, y1) = ((x + 1).min(last), (y + 1).min(last));
        let pixel = |x: usize, y: usize| Vec3A::from_array(self.rgb[y * self.side + x].map(f32::from));
        let f = at - at.floor();
        pixel(x, y).lerp(pixel(x1, y), f.x).lerp(pixel(x, y1).lerp(pixel(x1, y1), f.x), f.y) / 255.0
    }
}
