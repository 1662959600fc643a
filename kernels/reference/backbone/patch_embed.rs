//! Patch embedding.

use super::patchify::patchify;
use crate::ops::linear::linear;

/// Views of equal size.
pub struct Images {
    /// `[views, 3, height, width]` in 0..1.
    pub values: Vec<f64>,
    /// Number of views.
    pub views: usize,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
}

impl Images {
    /// Converts bytes `[views, 3, height, width]`, divided by 255 in f32 like the network's input.
    pub fn from_u8(bytes: &[u8], shape: &[usize]) -> Images {
        let values = bytes.iter().map(|&byte| f64::from(f32::from(byte) / 255.0)).collect();
        Images { values, views: shape[0], height: shape[2], width: shape[3] }
    }

    /// Returns rows and columns of patches.
    pub fn grid(&self, patch: usize) -> [usize; 2] {
        [self.height / patch, self.width / patch]
    }
}

/// Embeds patches by `weight [outputs, 3, patch, patch]` to `[views, patches, outputs]`.
pub fn patch_embed(images: &Images, weight: &[f32], bias: &[f32], patch: usize) -> Vec<f64> {
    linear(&patchify(images, patch), weight, bias)
}
