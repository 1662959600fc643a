use super::{
    Activation, Attention, AttentionKernel, Epilogue, Heads, Linear, Norm, ParameterLayout, Part, Pool, Rotary, Rows,
    row_chunks,
};
use crate::gpu::{Recorder, Tensor};
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Ffn {
    /// `fc2(gelu(fc1(x)))` with erf GELU.
    Gelu,
    /// `w3(silu(gate) * value)` with `w12(x)` = [gate | value].
    SwiGlu,
}

pub struct Block {
    heads: Heads,
    attention: AttentionKernel,
    norm1: Norm,
    qkv: Linear,
    qk_norm: Option<[Norm; 2]>,
    proj: Linear,
    gamma1: Tensor,
    mlp: Mlp,
}

pub(super) struct Mlp {
    pub norm: Norm,
    fc1: Linear,
    fc2: Linear,
    gamma: Tensor,
    activation: Activation,
}

/// Sequences in `[sequences * tokens, width]`.
#[derive(Clone, Copy, Debug)]
pub struct Sequences {
    pub count: usize,
    pub tokens: usize,
    pub rotary: Option<Rotary>,
    pub pool: Option<Pool>,
}

pub(super) const QK_NORM_EPS: f32 = 1e-5;

impl Block {
    /// Declares a block with epsilon `eps` in its residual norms.
    pub fn new(
        p: &mut ParameterLayout,
        name: &str,
        heads: Heads,
        qk_norm: bool,
        ffn: Ffn,
        hidden: usize,
        eps: f32,
    ) -> Self {
        let width = heads.width();
        let head_norm = |p: &mut ParameterLayout, n| p.norm(&format!("{name}.attn.{n}_norm"), heads.dim, QK_NORM_EPS);
        Self {
            heads,
            attention: p.attention(heads),
            norm1: p.norm(&format!("{name}.norm1"), width, eps),
            qkv: p.block_linear(&format!("{name}.attn.qkv"), width, 3 * width),
            qk_norm: qk_norm.then(|| ["q", "k"].map(|n| head_norm(p, n))),
            proj: p.block_linear(&format!("{name}.attn.proj"), width, width),
            gamma1: p.vector(&format!("{name}.ls1.gamma"), &[width]),
            mlp: Mlp::new(p, name, width, ffn, hidden, eps),
        }
    }

    pub fn record(&self, rec: &mut Recorder, x: Rows, sequences: Sequences) {
        let Sequences { count, tokens, rotary, pool } = sequences;
        let (heads, kernel, output, width) = (self.heads, self.attention, self.attention.element(), x.width);
        let attention = match pool {
            None => Attention { heads, sequences: count, queries: tokens, common_keys: 0, keys: tokens, kernel },
            Some(pool) => {
                let common_keys = pool.keys_of(x.count);
                let (sequences, keys) = if pool.own { (x.count / pool.tokens(), pool.tokens()) } else { (1, 0) };
                Attention { heads, sequences, queries: x.count / sequences, common_keys, keys, kernel }
            }
        };
        let tensors @ [q, k, v, log_counts] = attention.tensors(rec);
        for part in Pool::chunks(pool, rec, x.count, &[x.row_bytes(), output.bytes() * 3 * width]) {
            let normed = self.norm1.apply(rec, x.part(part.clone()), self.qkv.element());
            let qkv = self.qkv.apply(rec, "qkv", normed, output, Epilogue::default());
            let [q_norm, k_norm] = self.qk_norm.map_or([None; 2], |n| n.map(Some));
            let parts = [
                (Part { norm: q_norm, rotary, scale: attention.scale(), ..Part::default() }, q),
                (Part { norm: k_norm, rotary, keys: true, ..Part::default() }, k),
                (Part::default(), v),
            ];
            for (i, (what, out)) in parts.into_iter().enumerate() {
                let columns = qkv.columns(i * width, width);
                if i == 0 || attention.keys > 0 {
                    attention.split(rec, columns, part.start, what, out);
                }
                if let Some(pool) = pool.filter(|_| i > 0) {
                    attention.split_common(rec, columns, pool, part.start / pool.tokens(), what, [out, log_counts]);
                }
            }
        }
        let attended = attention.record(rec, tensors);
        let epilogue = Epilogue { gamma: Some(self.gamma1), residual: Some(x), ..Epilogue::default() };
        self.proj.record(rec, attended, x, epilogue);
        self.mlp.record(rec, x, None, x);
    }
}

impl Mlp {
    pub fn new(p: &mut ParameterLayout, name: &str, width: usize, ffn: Ffn, hidden: usize, eps: f32) -> Self {
        let norm = p.norm(&format!("{name}.norm2"), width, eps);
        let (fc1, fc2, activation) = match ffn {
            Ffn::Gelu => (
                p.block_linear(&format!("{name}.mlp.fc1"), width, hidden),
                p.block_linear(&format!("{name}.mlp.fc2"), hidden, width),
                Activation::Gelu,
            ),
            Ffn::SwiGlu => (
                p.gated_linear(&format!("{name}.mlp.w12"), width, 2 * hidden),
                p.block_linear(&format!("{name}.mlp.w3"), hidden, width),
                Activation::SwiGlu,
            ),
        };
        Self { norm, fc1, fc2, gamma: p.vector(&format!("{name}.ls2.gamma"), &[width]), activation }
    }

    /// `out` = `residual` + gamma * mlp(norm(`residual` + `addend`)).
    pub fn record(&self, rec: &mut Recorder, residual: Rows, addend: Option<Rows>, out: Rows) {
        let output = self.fc2.element();
        for part in row_chunks(rec, out.count, &[out.row_bytes(), output.bytes() * self.fc1.columns]) {
            let (residual, addend) = (residual.part(part.clone()), addend.map(|addend| addend.part(part.clone())));
            let normed = self.norm.apply_to_sum(rec, residual, addend, self.fc1.element());
            let activation = Epilogue { activation: self.activation, ..Epilogue::default() };
            let hidden = self.fc1.apply(rec, "hidden", normed, output, activation);
            let epilogue = Epilogue { gamma: Some(self.gamma), residual: Some(residual), ..Epilogue::default() };
            self.fc2.record(rec, hidden, out.part(part), epilogue);
        }
    }
}
