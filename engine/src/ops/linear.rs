//! Linear layers with fused epilogues.

use super::rows::{SCRATCH_BYTES, row_chunks};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{limits::LINEAR_ROWS, ops},
};

/// Narrower layers are cut as if they were this wide, which keeps their workgroups, rows / LINEAR_ROWS along x, below the
/// 65,535 that every device has.
const NARROWEST: usize = SCRATCH_BYTES as usize / (4 * LINEAR_ROWS as usize * 65_535) + 1;

/// A linear layer's parameters.
#[derive(Clone, Copy, Debug)]
pub struct Linear {
    /// `[panels, inner, PANEL_COLUMNS]` f32, the last panel padded.
    pub weight: Tensor,
    /// `[columns]` f32.
    pub bias: Tensor,
    /// Values of an input row, padded to a multiple of 4.
    pub inner: usize,
    /// Outputs, before SwiGLU halves them.
    pub columns: usize,
}

/// What follows the bias.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    #[default]
    None,
    /// The exact (erf) GELU.
    Gelu,
    /// silu(gate) * value; columns, a multiple of 4, alternate between the two. Without gamma and residual.
    SwiGlu,
}

/// out = residual + gamma * activation(linear(x)).
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue {
    /// Pointwise function.
    pub activation: Activation,
    /// LayerScale, `[columns]` f32.
    pub gamma: Option<Tensor>,
    /// `[rows, columns]` f32; may be the output itself.
    pub residual: Option<Tensor>,
}

impl Linear {
    /// Values of an output row.
    pub fn out_columns(&self, activation: Activation) -> usize {
        if activation == Activation::SwiGlu { self.columns / 2 } else { self.columns }
    }

    /// Applies the layer to `input` `[rows, inner]` into a new tensor.
    pub fn apply(&self, rec: &mut Recorder, name: &str, input: Tensor, rows: usize, epilogue: Epilogue) -> Tensor {
        let out = rec.tensor::<f32>(name, rows * self.out_columns(epilogue.activation));
        self.record(rec, input, rows, out, epilogue);
        out
    }

    /// Applies the layer to `input` `[rows, inner]` into `out` `[rows, columns]`.
    pub fn record(&self, rec: &mut Recorder, input: Tensor, rows: usize, out: Tensor, epilogue: Epilogue) {
        let alone = epilogue.gamma.is_none() && epilogue.residual.is_none() && self.columns.is_multiple_of(4);
        assert!(alone || epilogue.activation != Activation::SwiGlu, "SwiGLU comes alone and in whole vec4");
        let out_columns = self.out_columns(epilogue.activation);
        let lanes = rec.limits().subgroup_size as usize;
        for part in row_chunks(rec, rows, &[self.inner, out_columns, NARROWEST]) {
            let rows_of = |t: Tensor, width: usize| t.slice::<f32>(part.start * width, part.len() * width);
            let out = rows_of(out, out_columns);
            let kernel = ops::Linear {
                a: rows_of(input, self.inner),
                weight: self.weight,
                bias: self.bias,
                gamma: epilogue.gamma.unwrap_or(self.bias),
                residual: epilogue.residual.map_or(self.bias, |t| rows_of(t, out_columns)),
                out,
                rows: part.len() as u32,
                inner: self.inner as u32,
                columns: self.columns as u32,
                activation: epilogue.activation as u32,
                scale: epilogue.gamma.is_some(),
                add: epilogue.residual.is_some(),
            };
            let groups = [part.len().div_ceil(LINEAR_ROWS as usize), self.columns.div_ceil(4 * lanes), 1];
            let flops = 2 * part.len() * self.inner * self.columns;
            rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(flops as u64);
        }
    }
}
