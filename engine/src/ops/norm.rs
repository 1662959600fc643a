use super::{Columns, Rows, row_chunks, rows::row_subgroups};
use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::ops,
};

#[derive(Clone, Copy, Debug)]
pub struct Norm {
    /// `[width]` f32.
    pub weight: Tensor,
    /// `[width]` f32.
    pub bias: Tensor,
    pub width: usize,
    pub eps: f32,
}

impl Norm {
    /// Keeps all rows.
    pub const ALL: [usize; 2] = [0, 1];

    /// `input` is f32.
    pub fn apply(&self, rec: &mut Recorder, input: Rows, output: Element) -> Rows {
        self.apply_to_sum(rec, input, None, output)
    }

    /// Normalizes f32 `input` + `addend`.
    pub fn apply_to_sum(&self, rec: &mut Recorder, input: Rows, addend: Option<Rows>, output: Element) -> Rows {
        let out = Rows::scratch(rec, "normed", input.count, self.width, output);
        self.record(rec, input, addend, out, Self::ALL);
        out
    }

    /// Normalizes f32 `input` + `addend` into columns of `out`. Drops the `leading` special tokens
    /// ahead of every `patches` rows.
    pub fn record(
        &self,
        rec: &mut Recorder,
        input: Rows,
        addend: Option<Rows>,
        out: impl Into<Columns>,
        [leading, patches]: [usize; 2],
    ) {
        let Columns { of: out, first: out_column, .. } = out.into();
        let input_view = leading + patches;
        let widths = [input_view * input.row_bytes(), patches * input.row_bytes(), patches * out.row_bytes()];
        let subgroups = row_subgroups(rec.limits());
        for part in row_chunks(rec, out.count / patches, &widths) {
            let rows = part.start * patches..part.end * patches;
            let kernel = ops::LayerNorm {
                source: input.part(part.start * input_view..part.end * input_view).tensor,
                addend: addend.map_or(self.bias, |addend| addend.part(rows.clone()).tensor),
                weight: self.weight,
                bias: self.bias,
                out: out.part(rows.clone()).tensor,
                rows: rows.len() as u32,
                width: self.width as u32,
                out_stride: out.width as u32,
                out_column: out_column as u32,
                patches: patches as u32,
                leading: leading as u32,
                eps: self.eps,
                add: addend.is_some(),
                subgroups,
                output: out.element,
            };
            rec.dispatch_groups(kernel, rows.len().div_ceil(subgroups as usize));
        }
    }
}
