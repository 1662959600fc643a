//! Image losses `[height, width, 3]` and their gradients by the first image.

pub fn l1(a: &[f64], b: &[f64]) -> (f64, Vec<f64>) {
    pointwise(a, b, |d| (d.abs(), if d == 0.0 { 0.0 } else { d.signum() }))
}

pub fn mse(a: &[f64], b: &[f64]) -> (f64, Vec<f64>) {
    pointwise(a, b, |d| (d * d, 2.0 * d))
}

fn pointwise(a: &[f64], b: &[f64], of: fn(f64) -> (f64, f64)) -> (f64, Vec<f64>) {
    let all: Vec<(f64, f64)> = a.iter().zip(b).map(|(a, b)| of(a - b)).collect();
    let count = a.len() as f64;
    (all.iter().map(|x| x.0).sum::<f64>() / count, all.iter().map(|x| x.1 / count).collect())
}

/// Computes 1 - mean SSIM with an 11 x 11 Gaussian window of sigma 1.5; images are 0 outside.
pub fn dssim(a: &[f64], b: &[f64], width: usize) -> (f64, Vec<f64>) {
    let weights: Vec<f64> = (-5..=5).map(|x| (-f64::from(x * x) / 4.5).exp()).collect();
    let total: f64 = weights.iter().sum();
    let (height, count) = (a.len() / (3 * width), a.len() as f64);
    let (mut sum, mut gradient) = (0.0, vec![0.0; a.len()]);
    for i in 0..a.len() {
        let (x, y, color) = (i / 3 % width, i / 3 / width, i % 3);
        let seen: Vec<(f64, usize)> = (0..121)
            .filter_map(|tap| {
                let (x, y) = ((x + tap % 11).checked_sub(5)?, (y + tap / 11).checked_sub(5)?);
                let weight = weights[tap % 11] * weights[tap / 11] / (total * total);
                (x < width && y < height).then_some((weight, (y * width + x) * 3 + color))
            })
            .collect();
        let mean = |of: &dyn Fn(usize) -> f64| seen.iter().map(|&(weight, j)| weight * of(j)).sum::<f64>();
        let (ma, mb) = (mean(&|j| a[j]), mean(&|j| b[j]));
        let (aa, bb, ab) = (mean(&|j| a[j] * a[j]), mean(&|j| b[j] * b[j]), mean(&|j| a[j] * b[j]));
        let above = [2.0 * ma * mb + 1e-4, 2.0 * (ab - ma * mb) + 9e-4];
        let below = [ma * ma + mb * mb + 1e-4, aa - ma * ma + bb - mb * mb + 9e-4];
        let ssim = above[0] * above[1] / (below[0] * below[1]);
        sum += 1.0 - ssim;
        let both = below[0] * below[1];
        let by_a = 2.0 * mb * (above[1] - above[0]) / both - ssim * 2.0 * ma * (1.0 / below[0] - 1.0 / below[1]);
        let (by_aa, by_ab) = (-ssim / below[1], 2.0 * above[0] / both);
        for (weight, j) in seen {
            gradient[j] -= weight * (by_a + 2.0 * a[j] * by_aa + b[j] * by_ab) / count;
        }
    }
    (sum / count, gradient)
}

pub fn l1_dssim(a: &[f64], b: &[f64], width: usize) -> (f64, Vec<f64>) {
    let (l1, dssim) = (l1(a, b), dssim(a, b, width));
    let mixed = |a: f64, b: f64| 0.8 * a + 0.2 * b;
    (mixed(l1.0, dssim.0), l1.1.iter().zip(&dssim.1).map(|(a, b)| mixed(*a, *b)).collect())
}

/// Computes a loss of `a` with masked pixels (0 in `mask`) replaced by `b`'s, without gradient.
pub fn masked(loss: impl Fn(&[f64], &[f64]) -> (f64, Vec<f64>), a: &[f64], b: &[f64], mask: &[u8]) -> (f64, Vec<f64>) {
    let pick =
        |a: &[f64], b: &[f64]| (0..a.len()).map(|i| if mask[i / 3] == 0 { b[i] } else { a[i] }).collect::<Vec<_>>();
    let (value, gradient) = loss(&pick(a, b), b);
    (value, pick(&gradient, &vec![0.0; a.len()]))
}
