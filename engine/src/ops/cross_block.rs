//! A cross-attention block: queries look at keys; what it adds to the queries is returned on its own.

use super::{
    Attention, AttentionKernel, Epilogue, Ffn, Heads, Linear, Norm, ParameterLayout, Part,
    block::{Mlp, QK_NORM_EPS},
    row_chunks,
};
use crate::gpu::{Recorder, Tensor};

/// A cross-attention block's parameters.
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
    /// Lays out the block `name`, its feed-forward network with `hidden` channels.
    pub fn new(p: &mut ParameterLayout, name: &str, heads: Heads, hidden: usize, eps: f32) -> Self {
        let width = heads.width();
        Self {
            heads,
            attention: p.attention(),
            norm_q: p.norm(&format!("{name}.norm_q"), width, eps),
            norm_kv: p.norm(&format!("{name}.norm_kv"), width, eps),
            q_proj: p.block_linear(&format!("{name}.attn.q_proj"), width, width),
            kv_proj: p.block_linear(&format!("{name}.attn.kv_proj"), width, 2 * width),
            q_norm: p.norm(&format!("{name}.attn.q_norm"), heads.dim, QK_NORM_EPS),
            k_norm: p.norm(&format!("{name}.attn.k_norm"), heads.dim, QK_NORM_EPS),
            proj: p.block_linear(&format!("{name}.attn.proj"), width, width),
            gamma1: p.vector(&format!("{name}.ls1.gamma"), &[width]),
            mlp: Mlp::new(p, name, width, (Ffn::Gelu, hidden), eps),
        }
    }

    /// The two residuals d1 + d2 of `queries` `[count, width]` looking at `keys` `[key_count, width]`: d1 = gamma1 *
    /// attention, d2 = gamma2 * mlp(norm(queries + d1)).
    pub fn record(&self, rec: &mut Recorder, queries: (Tensor, usize), keys: (Tensor, usize)) -> Tensor {
        let width = self.heads.width();
        let (kernel, heads) = (self.attention, self.heads);
        let attention = Attention { heads, sequences: 1, queries: queries.1, keys: keys.1, kernel };
        let for_attention = Epilogue { output: kernel.element(), ..Epilogue::default() };
        let [q, k, v] = attention.tensors(rec);
        for part in row_chunks(rec, queries.1, &[4 * width]) {
            let x = queries.0.slice::<f32>(part.start * width, part.len() * width);
            let normed = self.norm_q.apply(rec, x, part.len(), self.q_proj.element());
            let projected = self.q_proj.apply(rec, "q", normed, part.len(), for_attention);
            let what = Part { norm: Some(self.q_norm), scale: attention.scale(), ..Part::default() };
            attention.split(rec, (projected, width), part.start, part.len(), what, q);
        }
        for part in row_chunks(rec, keys.1, &[4 * width, kernel.element().bytes() * 2 * width]) {
            let x = keys.0.slice::<f32>(part.start * width, part.len() * width);
            let normed = self.norm_kv.apply(rec, x, part.len(), self.kv_proj.element());
            let projected = self.kv_proj.apply(rec, "kv", normed, part.len(), for_attention);
            let parts = [
                (Part { norm: Some(self.k_norm), keys: true, ..Part::default() }, k),
                (Part { column: width, ..Part::default() }, v),
            ];
            for (what, out) in parts {
                attention.split(rec, (projected, 2 * width), part.start, part.len(), what, out);
            }
        }
        let attended = attention.record(rec, [q, k, v]);
        let epilogue = Epilogue { gamma: Some(self.gamma1), ..Epilogue::default() };
        let delta = self.proj.apply(rec, "delta", attended, queries.1, epilogue);
        self.mlp.record(rec, delta, Some(queries.0), delta, queries.1);
        delta
    }
}
