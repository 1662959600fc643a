//! Layer normalisation.

use super::row_chunks;
use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::ops,
};

/// A layer norm's parameters.
#[derive(Clone, Copy, Debug)]
pub struct Norm {
    /// `[width]` f32.
    pub weight: Tensor,
    /// `[width]` f32.
    pub bias: Tensor,
    /// Channels.
    pub width: usize,
    /// Added to the variance.
    pub eps: f32,
}

/// Which rows are normalised, and where they go.
#[derive(Clone, Copy, Debug)]
pub struct NormRows {
    /// Rows of the output.
    pub rows: usize,
    /// Values between the starts of two output rows.
    pub out_stride: usize,
    /// First column of the output.
    pub out_column: usize,
    /// Type of the output.
    pub output: Element,
    /// Patches of a view where the input has a camera token before each view's patches, which is left out; else 0.
    pub patches: usize,
}

impl NormRows {
    /// `rows` rows, packed, as f32.
    pub fn packed(rows: usize, width: usize) -> Self {
        Self { rows, out_stride: width, out_column: 0, output: Element::F32, patches: 0 }
    }
}

impl Norm {
    /// Normalises `input` `[rows, width]` into a new tensor of type `output`.
    pub fn apply(&self, rec: &mut Recorder, input: Tensor, rows: usize, output: Element) -> Tensor {
        self.apply_to_sum(rec, input, None, rows, output)
    }

    /// Normalises `input` (+ `addend`) `[rows, width]` into a new tensor of type `output`.
    pub fn apply_to_sum(
        &self,
        rec: &mut Recorder,
        input: Tensor,
        addend: Option<Tensor>,
        rows: usize,
        output: Element,
    ) -> Tensor {
        let out = rec.tensor_of(output, "normed", rows * self.width);
        self.record(rec, input, addend, out, NormRows { output, ..NormRows::packed(rows, self.width) });
        out
    }

    /// Normalises rows of `input` (+ `addend`, packed) into `out`.
    pub fn record(&self, rec: &mut Recorder, input: Tensor, addend: Option<Tensor>, out: Tensor, rows: NormRows) {
        let width = self.width;
        let (count, stride) = (rows.rows, rows.out_stride);
        // Cut at whole views where a view has a row more in the input than in the output.
        let view = rows.patches.max(1);
        let extra = rows.patches.min(1);
        let widths = [4 * (view + extra) * width, 4 * view * width, rows.output.bytes() * view * stride];
        for part in row_chunks(rec, count / view, &widths) {
            let (first, last) = (part.start * view, part.end * view);
            let (first_in, last_in) = (part.start * (view + extra), part.end * (view + extra));
            let kernel = ops::LayerNorm {
                source: input.slice::<f32>(first_in * width, (last_in - first_in) * width),
                addend: addend.map_or(self.bias, |t| t.slice::<f32>(first * width, (last - first) * width)),
                weight: self.weight,
                bias: self.bias,
                out: out.slice_of(rows.output, first * stride, (last - first) * stride),
                rows: (last - first) as u32,
                width: width as u32,
                out_stride: stride as u32,
                out_column: rows.out_column as u32,
                patches: rows.patches as u32,
                eps: self.eps,
                add: addend.is_some(),
                output: rows.output,
            };
            rec.dispatch_groups(kernel, last - first);
        }
    }
}
