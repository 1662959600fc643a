//! Sums of matrix products.

/// The sum of `scale^i a b` `[m, n]` over `i` below `iterations` and the matrices of `b` `[products, k, n]`, with `a [m, k]`.
pub fn products(a: &[f64], b: &[f64], [m, n, k]: [usize; 3], iterations: u32, scale: f64) -> Vec<f64> {
    let weight: f64 = (0..iterations).map(|i| scale.powf(f64::from(i))).sum();
    let entry = |row: usize, column: usize| -> f64 {
        b.chunks(k * n).map(|b| (0..k).map(|t| a[row * k + t] * b[t * n + column]).sum::<f64>()).sum()
    };
    (0..m * n).map(|i| weight * entry(i / n, i % n)).collect()
}
