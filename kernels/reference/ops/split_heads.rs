use super::layer_norm::layer_norm;
use super::place_columns::columns;
use crate::backbone::rope::rope;
use std::ops::Range;

#[derive(Clone, Copy)]
pub struct Part<'a> {
    pub column: usize,
    pub heads: usize,
    pub head_dim: usize,
    /// Weight, bias and epsilon of the LayerNorm over a head's channels.
    pub norm: Option<(&'a [f32], &'a [f32], f64)>,
    /// Rotary positions (y, x) of a view's tokens.
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

/// Keys and values of blocks across views.
#[derive(Clone, Debug)]
pub struct Keys {
    /// Sides of groups per block, the last for the rest; 0 for attention within views.
    pub sides: Vec<u8>,
    /// See [`Pool::own`].
    pub own: bool,
    /// See [`Pool::first`].
    pub first: bool,
}

impl Keys {
    pub fn all() -> Self {
        Self { sides: vec![1], own: false, first: false }
    }

    /// Returns the sequences of a block across `views`, and their pooling.
    pub fn of(&self, block: usize, views: usize, grid: [usize; 2], leading: usize) -> (usize, Option<Pool>) {
        let side = usize::from(self.sides[block.min(self.sides.len() - 1)]);
        let Self { own, first, .. } = *self;
        let pool = (side > 1).then_some(Pool { side, grid, leading, own, first });
        (if side == 0 { views } else { 1 }, pool)
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
    /// Whether a view's queries see its own tokens instead of its groups.
    pub own: bool,
    /// Whether the first view is unpooled.
    pub first: bool,
}

impl Pool {
    pub fn tokens(&self) -> usize {
        self.leading + self.grid[0] * self.grid[1]
    }

    /// Returns the rows of view `view`'s means.
    pub fn keys(&self, view: usize) -> Range<usize> {
        let pooled = self.leading + self.grid[0].div_ceil(self.side) * self.grid[1].div_ceil(self.side);
        let first = if self.first { self.tokens() } else { pooled };
        if view == 0 { 0..first } else { first + (view - 1) * pooled..first + view * pooled }
    }

    /// Returns group means of `x [views * tokens, width]`, and group sizes.
    pub fn means(&self, x: &[f64], width: usize) -> (Vec<f64>, Vec<f64>) {
        let Self { side, grid: [_, columns], leading, .. } = *self;
        let (tokens, across) = (self.tokens(), columns.div_ceil(side));
        let count = self.keys(x.len() / width / tokens).start;
        let (mut means, mut counts) = (vec![0.0; count * width], vec![0.0; count]);
        for (row, values) in x.chunks(width).enumerate() {
            let (view, token) = (row / tokens, row % tokens);
            let within = match token.checked_sub(leading) {
                Some(patch) if view > 0 || !self.first => {
                    leading + patch / columns / side * across + patch % columns / side
                }
                _ => token,
            };
            let group = self.keys(view).start + within;
            counts[group] += 1.0;
            means[group * width..][..width].iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
        }
        means.chunks_mut(width).zip(&counts).for_each(|(sums, count)| sums.iter_mut().for_each(|sum| *sum /= count));
        (means, counts)
    }

    /// Returns the rows of `x` that queries of `view` see: with `own`, its tokens last.
    pub fn seen(&self, x: &[f64], width: usize, view: usize) -> (Vec<f64>, Vec<f64>) {
        let (mut means, mut counts) = self.means(x, width);
        if self.own {
            let (Range { start, end }, tokens) = (self.keys(view), self.tokens());
            means.drain(start * width..end * width);
            means.extend(&x[view * tokens * width..(view + 1) * tokens * width]);
            counts.drain(start..end);
            counts.resize(counts.len() + tokens, 1.0);
        }
        (means, counts)
    }
}
