use rayon::prelude::*;

/// Computes `softmax(q k^T / sqrt(head_dim)) v` per head. `q` and the result `[queries, heads,
/// head_dim]`, `k` and `v [keys, heads, head_dim]`.
pub fn attention(q: &[f64], k: &[f64], v: &[f64], heads: usize, head_dim: usize) -> Vec<f64> {
    let once = vec![1.0; k.len() / (heads * head_dim)];
    attention_to_means(q, [k, v], &once, heads, head_dim)
}

/// Computes [`attention`] with each key counted `counts [keys]` times.
pub fn attention_to_means(q: &[f64], [k, v]: [&[f64]; 2], counts: &[f64], heads: usize, head_dim: usize) -> Vec<f64> {
    let width = heads * head_dim;
    let keys = k.len() / width;
    let scale = 1.0 / (head_dim as f64).sqrt();
    let attend = |row: usize, head: usize| {
        let query = &q[row * width + head * head_dim..][..head_dim];
        let key = |t: usize| &k[t * width + head * head_dim..][..head_dim];
        let scores: Vec<f64> =
            (0..keys).map(|t| scale * query.iter().zip(key(t)).map(|(a, b)| a * b).sum::<f64>()).collect();
        let largest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = scores.iter().zip(counts).map(|(score, n)| n * (score - largest).exp()).collect();
        let total: f64 = weights.iter().sum();
        let mut mixed = vec![0.0; head_dim];
        for (t, weight) in weights.iter().enumerate() {
            let value = &v[t * width + head * head_dim..][..head_dim];
            mixed.iter_mut().zip(value).for_each(|(sum, v)| *sum += weight / total * v);
        }
        mixed
    };
    let queries = q.len() / width;
    (0..queries * heads).into_par_iter().flat_map_iter(|i| attend(i / heads, i % heads)).collect()
}
