use crate::backbone::block::{EPS, head_norm, mlp};
use crate::model::Scope;
use crate::ops::add::add;
use crate::ops::attention::attention;
use crate::ops::linear::layer_scale;
use crate::ops::split_heads::{Part, split_heads};

/// Computes the residual of `queries [n, width]` attending to `keys [m, width]`: `d1 = gamma1 *
/// attention(norm_q(queries), norm_kv(keys))`, `d2 = gamma2 * mlp(norm2(queries + d1))`; returns
/// `d1 + d2`.
pub fn cross_attention(weights: &Scope, queries: &[f64], keys: &[f64], heads: usize) -> Vec<f64> {
    let parts = weights.scope("attn");
    let width = parts.get("proj.bias").len();
    let head_dim = width / heads;
    let q = parts.linear("q_proj", &weights.layer_norm("norm_q", queries, EPS));
    let kv = parts.linear("kv_proj", &weights.layer_norm("norm_kv", keys, EPS));
    let part = |column, norm| Part { column, heads, head_dim, norm, positions: None };
    let q = split_heads(&q, width, part(0, head_norm(&parts, "q_norm")));
    let k = split_heads(&kv, 2 * width, part(0, head_norm(&parts, "k_norm")));
    let v = split_heads(&kv, 2 * width, part(width, None));
    let mixed = attention(&q, &k, &v, heads, head_dim);
    let attended = layer_scale(&parts.linear("proj", &mixed), weights.get("ls1.gamma"));
    let hidden = mlp(&weights.scope("mlp"), &weights.layer_norm("norm2", &add(queries, &attended), EPS));
    add(&attended, &layer_scale(&hidden, weights.get("ls2.gamma")))
}
