use super::layer_norm::layer_norm;
use super::place_columns::columns;
use crate::backbone::rope::rope;

#[derive(Clone, Copy)]
pub struct Part<'a> {
    pub column: usize,
    pub heads: usize,
    pub head_dim: usize,
    /// Weight, bias and epsilon of the LayerNorm over a head's channels.
    pub norm: Option<(&'a [f32], &'a [f32], f64)>,
    /// Rotary positions (y, x) of a sequence's tokens.
    pub positions: Option<&'a [[f64; 2]]>,
}

/// Returns `part` of `projection [rows, stride]` as `[rows, heads, head_dim]`, normalized, then
/// rotated.
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

/// Pooling of keys and values over groups of a view's patches.
#[derive(Clone, Copy, Debug)]
pub struct Pool {
    /// Group side in patches.
    pub side: usize,
    /// Rows and columns of patches.
    pub grid: [usize; 2],
    /// Unpooled leading tokens.
    pub leading: usize,
}

impl Pool {
    /// Returns group means of `x [views * tokens, width]`, and group sizes.
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
