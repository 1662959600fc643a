/// Sums `a b` over `iterations` and the matrices of `b [products, k, n]`. Bits of `swaps`, modulo
/// 32, exchange the matrices of `a [2, m, k]` after an iteration.
pub fn products(a: &[f64], b: &[f64], [m, n, k]: [usize; 3], iterations: u32, swaps: u32) -> Vec<f64> {
    let (mut weights, mut current) = ([0.0; 2], 0);
    for i in 0..iterations {
        weights[current] += 1.0;
        if swaps >> (i % 32) & 1 == 1 {
            current = 1 - current;
        }
    }
    let left: Vec<f64> = (0..m * k).map(|i| weights[0] * a[i] + weights[1] * a[m * k + i]).collect();
    let entry = |row: usize, column: usize| -> f64 {
        b.chunks(k * n).map(|b| (0..k).map(|t| left[row * k + t] * b[t * n + column]).sum::<f64>()).sum()
    };
    (0..m * n).map(|i| entry(i / n, i % n)).collect()
}
