use super::{patchify::*, positions::interpolate};
use crate::{model::Scope, ops::add::add, widen};

/// Embeds images to the first tokens `[views, 1 + patches, width]`.
pub fn embed(weights: &Scope, images: &Images, patch: usize, width: usize) -> Vec<f64> {
    let [rows, columns] = images.grid(patch);
    let patches = weights.linear("patch_embed.proj", &patchify(images, patch));
    let positions = interpolate(&widen(weights.get("pos_embed")), width, rows, columns);
    let class = widen(weights.get("cls_token"));
    tokens(&patches, images.views, [&class; 2], 0, Some(&positions))
}

/// Places `special` tokens `[leading, width]`, of the reference view and of others, ahead of the
/// patches of each view, and adds `positions [leading + patches, width]`.
pub fn tokens(
    patches: &[f64],
    views: usize,
    special: [&[f64]; 2],
    reference: usize,
    positions: Option<&[f64]>,
) -> Vec<f64> {
    let view = |(i, patches): (usize, &[f64])| {
        let tokens = [special[usize::from(i != reference)], patches].concat();
        positions.map_or_else(|| tokens.clone(), |positions| add(&tokens, positions))
    };
    patches.chunks((patches.len() / views.max(1)).max(1)).enumerate().flat_map(view).collect()
}
