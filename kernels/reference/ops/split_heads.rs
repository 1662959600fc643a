//! Queries, keys or values of all heads out of a projection.

use super::layer_norm::layer_norm;
use super::place_columns::columns;
use crate::backbone::rope::rope;

/// Where a part is in a projection, and what happens to it before attention.
#[derive(Clone, Copy)]
pub struct Part<'a> {
    /// First column.
    pub column: usize,
    /// Attention heads.
    pub heads: usize,
    /// Channels of a head.
    pub head_dim: usize,
    /// Weight, bias and epsilon of the LayerNorm over a head's channels, which the heads share.
    pub norm: Option<(&'a [f32], &'a [f32], f64)>,
    /// Positions (y, x) of a sequence's tokens, where heads are rotated by them; the rows may be several sequences.
    pub positions: Option<&'a [[f64; 2]]>,
}

/// The part of `projection [rows, stride]` as `[rows, heads, head_dim]`, normed, then rotated.
pub fn split_heads(projection: &[f64], stride: usize, part: Part) -> Vec<f64> {
    let width = part.heads * part.head_dim;
    let mut x = columns(projection, stride, part.column, part.column + width);
    if let Some((weight, bias, eps)) = part.norm {
        x = layer_norm(&x, weight, bias, eps);
    }
    match part.positions {
        Some(positions) => x
            .chunks((positions.len() * width).max(1))
            .flat_map(|sequence| rope(sequence, positions, part.head_dim))
            .collect(),
        None => x,
    }
}
