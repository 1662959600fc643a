//! LPIPS: perceptual image distance.
//!
//! Source: Zhang et al. 2018, version 0.1.

mod features;
mod network;

pub use network::LpipsNetwork;

use crate::{
    gpu::{Recorder, Tensor},
    kernels::{loss::Value, lpips as kernels},
    ops::{FeatureMap, ParameterLayout, Rows, row_chunks},
};
use features::{Convolution, Inputs, Pool};
use network::Recipe;

pub const TAPS: usize = 5;

struct Layer {
    forward: Convolution,
    backward: Option<Convolution>,
    pool: Option<Pool>,
    /// `[channels]` f32.
    tap: Option<Tensor>,
}

pub struct Lpips {
    layers: Vec<Layer>,
}

/// Two images `[height, width, channels]` f32.
#[derive(Clone, Copy, Debug)]
pub struct LpipsPictures {
    /// Images and their channels, RGB first.
    pub pictures: [(Tensor, usize); 2],
    pub size: [usize; 2],
    /// Clamps to 0..1, as in the reference's loss only.
    pub clipped: bool,
}

#[derive(Clone, Copy, Debug)]
pub struct LpipsTensors {
    /// `[1]` f32.
    pub value: Tensor,
    /// `[TAPS]` f32.
    pub layers: Tensor,
}

impl Lpips {
    /// Declares `convolutions.I.weight` `[outputs, side, side, inputs]`, `convolutions.I.bias`,
    /// `taps.I.weight`.
    pub fn new(p: &mut ParameterLayout, network: LpipsNetwork, gradients: bool) -> Self {
        let (mut inputs, mut taps) = (3, 0..TAPS);
        let layer = |(i, recipe): (usize, Recipe)| {
            let Recipe { outputs, side, step, padding, pool, tap } = recipe;
            let name = format!("convolutions.{i}");
            let layer = p.exact_convolution(&name, &[side, side, inputs], outputs);
            let backward = gradients.then(|| {
                let layer = p.transposed_convolution(&name, [side, side], inputs, outputs);
                Convolution { layer, side, step: 1, padding: side - 1 - padding, spread: step }
            });
            inputs = outputs;
            let tap = if tap { taps.next() } else { None };
            Layer {
                forward: Convolution { layer, side, step, padding, spread: 1 },
                backward,
                pool,
                tap: tap.map(|i| p.vector(&format!("taps.{i}.weight"), &[outputs])),
            }
        };
        Self { layers: network.recipes().into_iter().enumerate().map(layer).collect() }
    }

    /// `gradient` is a weight and the tensor to accumulate the first image's gradient in.
    pub fn record(&self, rec: &mut Recorder, of: LpipsPictures, gradient: Option<(f32, Tensor)>) -> LpipsTensors {
        rec.scope("lpips", |rec| {
            let value = rec.tensor::<f32>("lpips", 1);
            let layers = rec.tensor::<f32>("layers", TAPS);
            let mut stages = vec![of.pictures.map(|(source, channels)| of.normalize(rec, source, channels))];
            let mut taps = 0..TAPS;
            for (i, layer) in self.layers.iter().enumerate() {
                stages.push(stages[i].map(|features| layer.forward(rec, features, i > 0)));
                if let (Some(weights), None) = (layer.tap, gradient) {
                    compare(rec, stages[i + 1], weights, layers, number(taps.next()), None);
                }
            }
            if let Some((weight, d_picture)) = gradient {
                let d = self.backward(rec, &stages, layers);
                of.normalize_backward(rec, d, weight, d_picture);
            }
            rec.dispatch_groups(Value { sums: layers, values: value, first: 0, count: TAPS as u32, scale: 1.0 }, 1u32);
            LpipsTensors { value, layers }
        })
    }

    fn backward(&self, rec: &mut Recorder, stages: &[[FeatureMap; 2]], layers: Tensor) -> FeatureMap {
        let mut taps = (0..TAPS).rev();
        let mut d: Option<FeatureMap> = None;
        for (layer, stages) in self.layers.iter().zip(stages.windows(2)).rev() {
            let [before, after] = [stages[0][0], stages[1][0]];
            if let Some(weights) = layer.tap {
                let into = d.unwrap_or_else(|| FeatureMap::scratch(rec, "d_features", after.size(), after.channels()));
                let add = d.is_some();
                compare(rec, stages[1], weights, layers, number(taps.next()), Some((into.rows, add)));
                d = Some(into);
            }
            d = Some(layer.backward(rec, d.expect("the last layer has a tap"), after, before));
        }
        d.expect("a layer")
    }
}

fn number(tap: Option<usize>) -> u32 {
    tap.expect("no more layers than TAPS have taps") as u32
}

fn compare(
    rec: &mut Recorder,
    [a, b]: [FeatureMap; 2],
    weights: Tensor,
    layers: Tensor,
    tap: u32,
    gradient: Option<(Rows, bool)>,
) {
    let (count, channels) = (a.rows.count, a.channels());
    let sums = rec.tensor::<f32>("sums", count);
    let scale = 1.0 / count as f32;
    for part in row_chunks(rec, count, &[a.rows.row_bytes(), 4]) {
        let rows = |rows: Rows| rows.part(part.clone()).tensor;
        let kernel = kernels::Compare {
            a: rows(a.rows),
            b: rows(b.rows),
            weights,
            sums: sums.slice::<f32>(part.start, part.len()),
            d_a: gradient.map_or(sums, |(d, _)| rows(d)),
            pixels: part.len() as u32,
            channels: channels as u32,
            scale,
            gradient: gradient.is_some(),
            add: gradient.is_some_and(|(_, add)| add),
        };
        rec.dispatch_groups(kernel, part.len());
    }
    rec.dispatch_groups(Value { sums, values: layers, first: tap, count: count as u32, scale: 1.0 }, 1u32);
}

impl LpipsPictures {
    fn normalize(&self, rec: &mut Recorder, source: Tensor, channels: usize) -> FeatureMap {
        let out = FeatureMap::scratch(rec, "normalized", self.size, 3);
        for part in row_chunks(rec, out.rows.count, &[4 * channels, 12]) {
            let kernel = kernels::Normalize {
                source: source.slice::<f32>(part.start * channels, part.len() * channels),
                out: out.rows.part(part.clone()).tensor,
                count: 3 * part.len() as u32,
                channels: channels as u32,
                clipped: self.clipped,
            };
            rec.dispatch(kernel, 3 * part.len());
        }
        out
    }

    fn normalize_backward(&self, rec: &mut Recorder, d: FeatureMap, weight: f32, d_picture: Tensor) {
        let (source, channels) = self.pictures[0];
        for part in row_chunks(rec, d.rows.count, &[4 * channels, 12]) {
            let of = |t: Tensor| t.slice::<f32>(part.start * channels, part.len() * channels);
            let kernel = kernels::NormalizeBackward {
                source: of(source),
                d_out: d.rows.part(part.clone()).tensor,
                d_source: of(d_picture),
                count: 3 * part.len() as u32,
                channels: channels as u32,
                weight,
                clipped: self.clipped,
            };
            rec.dispatch(kernel, 3 * part.len());
        }
    }
}

impl Layer {
    fn forward(&self, rec: &mut Recorder, before: FeatureMap, rectified: bool) -> FeatureMap {
        let convolution = &self.forward;
        let (source, inputs) = match &self.pool {
            Some(pool) => (pool.forward(rec, before), Inputs::AsTheyAre),
            None if rectified => (before, Inputs::Rectified),
            None => (before, Inputs::AsTheyAre),
        };
        let side = |side: usize| (side + 2 * convolution.padding - convolution.side) / convolution.step + 1;
        convolution.record(rec, "features", source, inputs, source.size().map(side))
    }

    fn backward(&self, rec: &mut Recorder, d: FeatureMap, after: FeatureMap, before: FeatureMap) -> FeatureMap {
        let convolution = self.backward.as_ref().expect("a network with gradients");
        let size = self.pool.as_ref().map_or(before.size(), |pool| pool.size(before));
        let d = convolution.record(rec, "d_features", d, Inputs::Gated(after), size);
        self.pool.as_ref().map_or(d, |pool| pool.backward(rec, before, d))
    }
}
