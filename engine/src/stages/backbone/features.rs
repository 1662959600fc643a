//! Out-layer features: the local and the global half, normalised, merged to the model's width.

use crate::{
    gpu::{Recorder, Tensor},
    kernels::backbone as kernels,
    ops::{Epilogue, Linear, Norm, NormRows, ParameterLayout, row_chunks},
    stages::{Architecture, ViewGrid},
};

const EPS: f32 = 1e-5;

/// One for each out layer, 0 the deepest.
pub(super) struct Features {
    width: usize,
    local_norms: Vec<Norm>,
    global_norms: Vec<Norm>,
    downscales: Vec<Linear>,
}

impl Features {
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        let layers = 0..a.out_layers.len();
        Self {
            width: a.width,
            local_norms: layers.clone().map(|j| p.norm(&format!("pre_norm_local.{j}"), a.width, EPS)).collect(),
            global_norms: layers.clone().map(|j| p.norm(&format!("pre_norm_global.{j}"), a.width, EPS)).collect(),
            downscales: layers.map(|j| p.linear(&format!("downscale.{j}"), 2 * a.width, a.width)).collect(),
        }
    }

    /// Prepares feature `j` (0 is the deepest) from the residual stream after its block, `global`, and after the newest
    /// local block: W [a | b] + bias + (a + b) / 2 with a = norm(local), b = norm(final_norm(global)). Camera tokens
    /// are left out.
    pub fn record(
        &self,
        rec: &mut Recorder,
        j: usize,
        local: Tensor,
        global: Tensor,
        final_norm: Norm,
        grid: ViewGrid,
    ) -> Tensor {
        let downscale = self.downscales[j];
        let (width, patches) = (self.width, grid.patches());
        let out = rec.tensor::<f32>("prepared", grid.tokens() * width);
        let output = downscale.element();
        let widths = [4 * (1 + patches) * width, output.bytes() * patches * 2 * width, 4 * patches * width];
        for part in row_chunks(rec, grid.views, &widths) {
            let stream = (1 + patches) * width;
            let views_of = |t: Tensor| t.slice::<f32>(part.start * stream, part.len() * stream);
            let rows = part.len() * patches;
            let halves = rec.tensor_of(output, "halves", rows * 2 * width);
            let left = NormRows { rows, out_stride: 2 * width, out_column: 0, output, patches };
            self.local_norms[j].record(rec, views_of(local), None, halves, left);
            let finished = rec.tensor::<f32>("finished", rows * width);
            let packed = NormRows { patches, ..NormRows::packed(rows, width) };
            final_norm.record(rec, views_of(global), None, finished, packed);
            let right = NormRows { rows, out_stride: 2 * width, out_column: width, output, patches: 0 };
            self.global_norms[j].record(rec, finished, None, halves, right);

            let out = out.slice::<f32>(part.start * patches * width, rows * width);
            let (rows32, width32) = (rows as u32, width as u32);
            let kernel = kernels::AverageHalves { halves, out, rows: rows32, width: width32, input: output };
            rec.dispatch(kernel, rows * width);
            let epilogue = Epilogue { residual: Some(out), ..Epilogue::default() };
            downscale.record(rec, halves, rows, out, epilogue);
        }
        rec.observe(&format!("prep/layer{j}"), out);
        out
    }
}
