//! Raw Gaussians.

use crate::backbone::block::mlp;
use crate::model::Scope;
use crate::ops::place_columns::join_columns;

/// Decodes scene tokens `[n, width]` and color tokens `[n, color_width]` to `[n, G * (11 + 3K)]`.
pub fn head(weights: &Scope, scene: &[f64], width: usize, color: &[f64], color_width: usize) -> Vec<f64> {
    weights.linear("1", &mlp(&weights.scope("0"), &join_columns(scene, width, color, color_width)))
}
