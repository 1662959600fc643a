use rayon::prelude::*;

/// Multiplies `x [rows, inputs]` by `weight [outputs, inputs]` transposed and adds `bias`.
pub fn linear(x: &[f64], weight: &[f32], bias: &[f32]) -> Vec<f64> {
    let inputs = weight.len() / bias.len();
    let output = |row: &[f64], j: usize| {
        let products = row.iter().zip(&weight[j * inputs..]).map(|(x, &w)| x * f64::from(w));
        products.sum::<f64>() + f64::from(bias[j])
    };
    x.par_chunks(inputs).flat_map_iter(|row| (0..bias.len()).map(move |j| output(row, j))).collect()
}

pub fn layer_scale(x: &[f64], gamma: &[f32]) -> Vec<f64> {
    x.chunks(gamma.len()).flat_map(|row| row.iter().zip(gamma).map(|(x, &g)| x * f64::from(g))).collect()
}
