//! Cross-attention with its MLP.

use crate::reference::backbone::block::{EPS, mlp, norm_heads};
use crate::reference::model::Scope;
use crate::reference::ops::attention::attention;
use crate::reference::ops::linear::{add, layer_scale};

/// What a cross-attention block adds to `queries [n, width]` that attend to `keys [m, width]`:
/// `d1 = gamma1 * attention(norm_q(queries), norm_kv(keys))`, `d2 = gamma2 * mlp(norm2(queries + d1))`; gives `d1 + d2`.
pub fn cross_attention(weights: &Scope, queries: &[f64], keys: &[f64], heads: usize) -> Vec<f64> {
    let parts = weights.scope("attn");
    let width = parts.get("proj.bias").len();
    let q = norm_heads(&parts, "q_norm", parts.linear("q_proj", &weights.layer_norm("norm_q", queries, EPS)));
    let kv = parts.linear("kv_proj", &weights.layer_norm("norm_kv", keys, EPS));
    let (k, v): (Vec<_>, Vec<_>) = kv.chunks(2 * width).map(|row| row.split_at(width)).unzip();
    let k = norm_heads(&parts, "k_norm", k.concat());
    let mixed = attention(&q, &k, &v.concat(), heads, width / heads);
    let attended = layer_scale(&parts.linear("proj", &mixed), weights.get("ls1.gamma"));
    let hidden = mlp(&weights.scope("mlp"), &weights.layer_norm("norm2", &add(queries, &attended), EPS));
    add(&attended, &layer_scale(&hidden, weights.get("ls2.gamma")))
}
