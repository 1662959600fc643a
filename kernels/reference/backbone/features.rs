use super::average_halves::average_halves;
use super::block::EPS;
use crate::model::Model;
use crate::ops::add::add;
use crate::ops::place_columns::{columns, join_columns};

/// Returns `[local | normed]` per token, without camera tokens. Inputs `[views, tokens, width]`,
/// result `[views, tokens - 1, 2 width]`.
pub fn feature(local: &[f64], normed: &[f64], width: usize, tokens: usize) -> Vec<f64> {
    let rows = local.chunks(width).zip(normed.chunks(width)).enumerate();
    let patches = rows.filter(|(row, _)| row % tokens != 0);
    patches.flat_map(|(_, (local, normed))| local.iter().chain(normed)).copied().collect()
}

/// Merges a feature `[rows, 2 width]` to `[rows, width]`: normalized halves through a linear layer,
/// plus their mean. `layer` counts from the deepest.
pub fn prepare(model: &Model, feature: &[f64], layer: usize) -> Vec<f64> {
    let width = model.architecture.width;
    let layer = layer.to_string();
    let half = |start: usize| columns(feature, 2 * width, start, start + width);
    let local = model.scope("pre_norm_local").layer_norm(&layer, &half(0), EPS);
    let global = model.scope("pre_norm_global").layer_norm(&layer, &half(width), EPS);
    let joined = join_columns(&local, width, &global, width);
    add(&model.scope("downscale").linear(&layer, &joined), &average_halves(&joined, width))
}
