//! LPIPS 0.1 (Zhang et al. 2018).

pub mod compare;
pub mod normalize;
pub mod pool;

use super::ops::{im2col::im2col, linear::linear};

pub struct Layer {
    /// `[outputs, side, side, inputs]`.
    pub weight: Vec<f32>,
    /// `[outputs]`.
    pub bias: Vec<f32>,
    pub side: usize,
    pub step: usize,
    pub padding: usize,
    /// Side and stride of the preceding pooling.
    pub pool: Option<[usize; 2]>,
    /// Feature weights `[outputs]`, if compared.
    pub tap: Option<Vec<f32>>,
}

/// `[height, width, channels]`.
struct Features {
    values: Vec<f64>,
    width: usize,
    channels: usize,
}

/// Computes the distance of two images `[height, width, 3]` in 0..1, per compared layer.
pub fn lpips(layers: &[Layer], [a, b]: [&[f64]; 2], width: usize, clipped: bool) -> Vec<f64> {
    let [a, b] = [a, b].map(|picture| taps(layers, picture, width, clipped));
    let weights = layers.iter().filter_map(|layer| layer.tap.as_deref());
    let mean = |pixels: Vec<f64>| pixels.iter().sum::<f64>() / pixels.len() as f64;
    a.iter().zip(&b).zip(weights).map(|((a, b), weights)| mean(compare::compare(a, b, weights))).collect()
}

fn taps(layers: &[Layer], picture: &[f64], width: usize, clipped: bool) -> Vec<Vec<f64>> {
    let mut found = Vec::new();
    let mut features = Features { values: normalize::normalize(picture, clipped), width, channels: 3 };
    for layer in layers {
        if let Some([side, step]) = layer.pool {
            let shape = [features.width, features.channels];
            features.values = pool::pool(&features.values, shape, side, step);
            features.width = (features.width - side) / step + 1;
        }
        features = layer.features(&features);
        found.extend(layer.tap.is_some().then(|| features.values.clone()));
    }
    found
}

impl Layer {
    fn features(&self, source: &Features) -> Features {
        let height = source.values.len() / (source.width * source.channels);
        let [height, width] = [height, source.width].map(|side| (side + 2 * self.padding - self.side) / self.step + 1);
        let shape = [self.side, self.step, self.padding, 1];
        let rows = im2col(&source.values, [source.width, source.channels], shape, [height, width]);
        let values = linear(&rows, &self.weight, &self.bias).into_iter().map(|x| x.max(0.0)).collect();
        Features { values, width, channels: self.bias.len() }
    }
}
