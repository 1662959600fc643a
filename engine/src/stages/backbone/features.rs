use super::transformer::OutLayer;
use crate::{
    gpu::{Element, Recorder},
    kernels::backbone as kernels,
    ops::{Epilogue, Linear, Norm, ParameterLayout, Rows, row_chunks},
    stages::{Architecture, ViewGrid},
};

const EPS: f32 = 1e-5;

/// Deepest first.
pub(super) struct Features {
    local_norms: Vec<Norm>,
    global_norms: Vec<Norm>,
    downscales: Vec<Linear>,
}

impl Features {
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        let layers = 0..a.out_layers.len();
        Self {
            local_norms: layers.clone().map(|j| p.norm(&format!("pre_norm_local.{j}"), a.width, EPS)).collect(),
            global_norms: layers.clone().map(|j| p.norm(&format!("pre_norm_global.{j}"), a.width, EPS)).collect(),
            downscales: layers.map(|j| p.linear(&format!("downscale.{j}"), 2 * a.width, a.width)).collect(),
        }
    }

    pub fn layers(&self) -> usize {
        self.downscales.len()
    }

    /// Returns W [a | b] + bias + (a + b) / 2 with a = norm(local), b = norm(final_norm(global)),
    /// without special tokens.
    pub fn record(
        &self,
        rec: &mut Recorder,
        j: usize,
        OutLayer { local, global, leading }: OutLayer,
        final_norm: Option<Norm>,
        grid: ViewGrid,
    ) -> Rows {
        let (width, patches, downscale) = (global.width, grid.patches(), self.downscales[j]);
        let out = Rows::scratch(rec, "prepared", grid.tokens(), width, Element::F32);
        let (output, view) = (downscale.element(), [leading, patches]);
        let widths =
            [(leading + patches) * global.row_bytes(), output.bytes() * patches * 2 * width, patches * out.row_bytes()];
        for part in row_chunks(rec, grid.views, &widths) {
            let rows_of_views = |rows: Rows, tokens: usize| rows.part(part.start * tokens..part.end * tokens);
            let out = rows_of_views(out, patches);
            let halves = Rows::scratch(rec, "halves", out.count, 2 * width, output);
            let [local, global] = [local, global].map(|rows| rows_of_views(rows, leading + patches));
            let [left, right] = [0, width].map(|first| halves.columns(first, width));
            self.local_norms[j].record(rec, local, None, left, view);
            match final_norm {
                Some(norm) => {
                    let finished = Rows::scratch(rec, "finished", out.count, width, Element::F32);
                    norm.record(rec, global, None, finished, view);
                    self.global_norms[j].record(rec, finished, None, right, Norm::ALL);
                }
                None => self.global_norms[j].record(rec, global, None, right, view),
            }
            let kernel = kernels::AverageHalves {
                halves: halves.tensor,
                out: out.tensor,
                rows: out.count as u32,
                width: width as u32,
                input: output,
            };
            rec.dispatch(kernel, out.values());
            let epilogue = Epilogue { residual: Some(out), ..Epilogue::default() };
            downscale.record(rec, halves, out, epilogue);
        }
        rec.observe(&format!("prep/layer{j}"), out.tensor);
        out
    }
}
