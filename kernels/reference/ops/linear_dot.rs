//! 8-bit linear layers.

use rayon::prelude::*;

/// Multiplies `x [rows, inputs]` by `weight [outputs, inputs]` transposed, scales, and adds `bias`.
pub fn linear_dot(
    (x, row_scales): (&[i8], &[f32]),
    (weight, column_scales): (&[i8], &[f32]),
    bias: &[f32],
) -> Vec<f64> {
    let inputs = weight.len() / bias.len();
    let output = |(row, &scale): (&[i8], &f32), j: usize| {
        let products = row.iter().zip(&weight[j * inputs..]).map(|(&x, &w)| i64::from(x) * i64::from(w));
        products.sum::<i64>() as f64 * f64::from(scale) * f64::from(column_scales[j]) + f64::from(bias[j])
    };
    let rows = x.par_chunks(inputs).zip(row_scales);
    rows.flat_map_iter(|row| (0..bias.len()).map(move |j| output(row, j))).collect()
}
