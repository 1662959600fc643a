use crate::model::Scope;
use crate::ops::activation::{gelu, swiglu};
use crate::ops::add::add;
use crate::ops::attention::{attention, attention_to_means};
use crate::ops::linear::layer_scale;
use crate::ops::split_heads::{Part, Pool, split_heads};

pub const EPS: f64 = 1e-5;

#[derive(Clone, Copy)]
pub struct Options<'a> {
    pub heads: usize,
    /// Epsilon of `norm1` and `norm2`.
    pub eps: f64,
    /// Sequences that attend within themselves.
    pub sequences: usize,
    /// Rotary positions (y, x) of a view's tokens.
    pub positions: Option<&'a [[f64; 2]]>,
    /// Pooling of keys and values of one sequence.
    pub pool: Option<Pool>,
}

/// Computes `x += gamma1 * proj(attention(norm1(x))); x += gamma2 * mlp(norm2(x))`.
pub fn block(weights: &Scope, x: &[f64], options: Options) -> Vec<f64> {
    let attended = self_attention(&weights.scope("attn"), &weights.layer_norm("norm1", x, options.eps), options);
    let x = add(x, &layer_scale(&attended, weights.get("ls1.gamma")));
    let hidden = mlp(&weights.scope("mlp"), &weights.layer_norm("norm2", &x, options.eps));
    add(&x, &layer_scale(&hidden, weights.get("ls2.gamma")))
}

fn self_attention(weights: &Scope, x: &[f64], options: Options) -> Vec<f64> {
    let width = weights.get("proj.bias").len();
    let head_dim = width / options.heads;
    let qkv = weights.linear("qkv", x);
    let part = |i: usize, norm, positions| {
        let part = Part { column: i * width, heads: options.heads, head_dim, norm, positions };
        split_heads(&qkv, 3 * width, part)
    };
    let q = part(0, head_norm(weights, "q_norm"), options.positions);
    let k = part(1, head_norm(weights, "k_norm"), options.positions);
    let v = part(2, None, None);
    if let Some(pool) = options.pool {
        let queries = if pool.own { pool.tokens() * width } else { q.len() };
        let attend = |(view, q): (usize, &[f64])| {
            let ((k, counts), (v, _)) = (pool.seen(&k, width, view), pool.seen(&v, width, view));
            attention_to_means(q, [&k, &v], &counts, options.heads, head_dim)
        };
        return weights.linear("proj", &q.chunks(queries).enumerate().flat_map(attend).collect::<Vec<_>>());
    }
    let length = x.len() / options.sequences;
    let sequences = q.chunks(length).zip(k.chunks(length)).zip(v.chunks(length));
    let mixed: Vec<f64> = sequences.flat_map(|((q, k), v)| attention(q, k, v, options.heads, head_dim)).collect();
    weights.linear("proj", &mixed)
}

pub fn head_norm<'a>(weights: &Scope<'a>, name: &str) -> Option<(&'a [f32], &'a [f32], f64)> {
    let parameter = |kind| format!("{name}.{kind}");
    weights.has(&parameter("weight")).then(|| (weights.get(&parameter("weight")), weights.get(&parameter("bias")), EPS))
}

pub fn mlp(weights: &Scope, x: &[f64]) -> Vec<f64> {
    if weights.has("w12.weight") {
        let gate_value = weights.linear("w12", x);
        return weights.linear("w3", &swiglu(&gate_value, weights.get("w12.bias").len() / 2));
    }
    let hidden: Vec<f64> = weights.linear("fc1", x).into_iter().map(gelu).collect();
    weights.linear("fc2", &hidden)
}
