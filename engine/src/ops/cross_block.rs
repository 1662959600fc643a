//! A cross-attention block that returns a residual.

use super::{
    Attention, AttentionKernel, Epilogue, Ffn, Heads, Linear, Norm, ParameterLayout, Part, Rows,
    block::{Mlp, QK_NORM_EPS},
    row_chunks,
};
use crate::gpu::{Element, Recorder, Tensor};

pub struct CrossBlock {
    heads: Heads,
    attention: AttentionKernel,
    norm_q: Norm,
    norm_kv: Norm,
    q_proj: Linear,
    kv_proj: Linear,
    q_norm: Norm,
    k_norm: Norm,
    proj: Linear,
    gamma1: Tensor,
    mlp: Mlp,
}

impl CrossBlock {
    pub fn new(p: &mut ParameterLayout, name: &str, heads: Heads, hidden: usize, eps: f32) -> Self {
        let width = heads.width();
        Self {
            heads,
            attention: p.attention(heads),
            norm_q: p.norm(&format!("{name}.norm_q"), width, eps),
            norm_kv: p.norm(&format!("{name}.norm_kv"), width, eps),
            q_proj: p.block_linear(&format!("{name}.attn.q_proj"), width, width),
            kv_proj: p.block_linear(&format!("{name}.attn.kv_proj"), width, 2 * width),
            q_norm: p.norm(&format!("{name}.attn.q_norm"), heads.dim, QK_NORM_EPS),
            k_norm: p.norm(&format!("{name}.attn.k_norm"), heads.dim, QK_NORM_EPS),
            proj: p.block_linear(&format!("{name}.attn.proj"), width, width),
            gamma1: p.vector(&format!("{name}.ls1.gamma"), &[width]),
            mlp: Mlp::new(p, name, width, Ffn::Gelu, hidden, eps),
        }
    }

    /// Returns d1 + d2 with d1 = gamma1 * attention and d2 = gamma2 * mlp(norm(queries + d1)).
    pub fn record(&self, rec: &mut Recorder, queries: Rows, keys: Rows) -> Rows {
        let (heads, kernel, output, width) = (self.heads, self.attention, self.attention.element(), queries.width);
        let attention =
            Attention { heads, sequences: 1, queries: queries.count, common_keys: 0, keys: keys.count, kernel };
        let tensors @ [q, k, v, _] = attention.tensors(rec);
        for part in row_chunks(rec, queries.count, &[queries.row_bytes()]) {
            let normed = self.norm_q.apply(rec, queries.part(part.clone()), self.q_proj.element());
            let projected = self.q_proj.apply(rec, "q", normed, output, Epilogue::default());
            let what = Part { norm: Some(self.q_norm), scale: attention.scale(), ..Part::default() };
            attention.split(rec, projected, part.start, what, q);
        }
        for part in row_chunks(rec, keys.count, &[keys.row_bytes(), output.bytes() * 2 * width]) {
            let normed = self.norm_kv.apply(rec, keys.part(part.clone()), self.kv_proj.element());
            let projected = self.kv_proj.apply(rec, "kv", normed, output, Epilogue::default());
            let of_keys = Part { norm: Some(self.k_norm), keys: true, ..Part::default() };
            attention.split(rec, projected.columns(0, width), part.start, of_keys, k);
            attention.split(rec, projected.columns(width, width), part.start, Part::default(), v);
        }
        let attended = attention.record(rec, tensors);
        let epilogue = Epilogue { gamma: Some(self.gamma1), ..Epilogue::default() };
        let delta = self.proj.apply(rec, "delta", attended, Element::F32, epilogue);
        self.mlp.record(rec, delta, Some(queries), delta);
        delta
    }
}
