//! Patch embedding.

use super::patchify::{Images, patchify};
use crate::ops::linear::linear;

/// Embeds patches by `weight [outputs, 3, patch, patch]` to `[views, patches, outputs]`.
pub fn patch_embed(images: &Images, weight: &[f32], bias: &[f32], patch: usize) -> Vec<f64> {
    linear(&patchify(images, patch), weight, bias)
}
