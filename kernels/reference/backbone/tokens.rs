//! First tokens.

use super::{patchify::*, positions::interpolate};
use crate::{model::Scope, ops::add::add, widen};

/// Embeds images to the first tokens `[views, 1 + patches, width]`.
pub fn embed(weights: &Scope, images: &Images, patch: usize, width: usize) -> Vec<f64> {
    let [rows, columns] = images.grid(patch);
    let patches = weights.linear("patch_embed.proj", &patchify(images, patch));
    let positions = interpolate(&widen(weights.get("pos_embed")), width, rows, columns);
    tokens(&patches, &widen(weights.get("cls_token")), &positions)
}

/// Adds `positions [1 + patches, width]` to class token and `patches [views, patches, width]`.
pub fn tokens(patches: &[f64], class: &[f64], positions: &[f64]) -> Vec<f64> {
    let views = patches.chunks(positions.len() - class.len());
    views.flat_map(|patches| add(&[class, patches].concat(), positions)).collect()
}
