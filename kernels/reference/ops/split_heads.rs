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

/// Groups of neighbouring patches of each view, whose keys and values are averaged.
#[derive(Clone, Copy, Debug)]
pub struct Pool {
    /// Patches of a group along each side.
    pub side: usize,
    /// Rows and columns of a view's patches.
    pub grid: [usize; 2],
    /// Tokens before a view's patches, which stay as they are.
    pub leading: usize,
}

impl Pool {
    /// The means of the groups of `x [views * tokens, width]`, and of how many rows each is.
    pub fn means(&self, x: &[f64], width: usize) -> (Vec<f64>, Vec<f64>) {
        let Self { side, grid: [rows, columns], leading } = *self;
        let (tokens, across) = (leading + rows * columns, columns.div_ceil(side));
        let groups = leading + rows.div_ceil(side) * across;
        let count = x.len() / width / tokens * groups;
        let (mut means, mut counts) = (vec![0.0; count * width], vec![0.0; count]);
        for (row, values) in x.chunks(width).enumerate() {
            let token = row % tokens;
            let within = match token.checked_sub(leading) {
                Some(patch) => leading + patch / columns / side * across + patch % columns / side,
                None => token,
            };
            let group = row / tokens * groups + within;
            counts[group] += 1.0;
            means[group * width..][..width].iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
        means.chunks_mut(width).zip(&counts).for_each(|(sums, count)| sums.iter_mut().for_each(|sum| *sum /= count));
        (means, counts)
    }
}
