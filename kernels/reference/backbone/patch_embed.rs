//! Pictures to patch tokens: a convolution whose stride is its size.

use super::patchify::patchify;
use crate::ops::linear::linear;

/// Views of one size, `values [views, 3, height, width]` in `[0, 1]`.
pub struct Images {
    /// Channel-major values of all views.
    pub values: Vec<f64>,
    /// Number of views.
    pub views: usize,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
}

impl Images {
    /// From bytes `[views, 3, height, width]`; divided by 255 in f32, as the network's input is.
    pub fn from_u8(bytes: &[u8], shape: &[usize]) -> Images {
        let values = bytes.iter().map(|&byte| f64::from(f32::from(byte) / 255.0)).collect();
        Images { values, views: shape[0], height: shape[2], width: shape[3] }
    }

    /// Rows and columns of patches of a view.
    pub fn grid(&self, patch: usize) -> [usize; 2] {
        [self.height / patch, self.width / patch]
    }
}

/// `weight [outputs, 3, patch, patch]`; gives `[views, patches row-major, outputs]`.
pub fn patch_embed(images: &Images, weight: &[f32], bias: &[f32], patch: usize) -> Vec<f64> {
    linear(&patchify(images, patch), weight, bias)
}
