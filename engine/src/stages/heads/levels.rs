//! The four levels: features at 4x, 2x, 1x and 1/2 of the patch grid.

use super::{
    convolution::{Convolution, ConvolutionOptions},
    position::Positions,
};
use crate::{
    gpu::{Element, Recorder, Tensor},
    ops::{FeatureMap, Linear, Norm, ParameterLayout, Rows},
    stages::DepthArchitecture,
};

const EPS: f32 = 1e-5;

pub(super) struct Levels {
    norm: Option<Norm>,
    placed: bool,
    projects: [Linear; 4],
    spread: [(Linear, Tensor); 2],
    reduce: Convolution,
    layers: [Convolution; 4],
}

const SIDES: [usize; 2] = [4, 2];

impl Levels {
    pub fn new(p: &mut ParameterLayout, a: &DepthArchitecture, root: &str, normed: bool, placed: bool) -> Self {
        let (inner, [first, second, _, last]) = (a.feature_width(), a.channels);
        Self {
            norm: normed.then(|| p.norm(&format!("{root}.norm"), inner, EPS)),
            placed,
            projects: [0, 1, 2, 3]
                .map(|j| p.exact_convolution(&format!("{root}.projects.{j}"), &[inner, 1, 1], a.channels[j])),
            spread: [(0, first), (1, second)].map(|(j, channels)| {
                let name = format!("{root}.resize_layers.{j}");
                let layer = p.spread_convolution(&name, [channels; 2], SIDES[j]);
                (layer, p.vector(&format!("{name}.bias"), &[channels]))
            }),
            reduce: Convolution::new(p, &format!("{root}.resize_layers.3"), [last; 2], 3).strided(),
            layers: [0, 1, 2, 3].map(|j| {
                let (name, channels) = (format!("{root}.scratch.layer{}_rn", j + 1), [a.channels[j], a.features]);
                Convolution::of(p.planar_convolution(&name, channels, 3, false), [3, 1])
            }),
        }
    }

    /// Shallowest first.
    pub fn record(
        &self,
        rec: &mut Recorder,
        tap: &str,
        features: &[Rows],
        size: [usize; 2],
        positions: &mut Positions,
    ) -> [FeatureMap; 4] {
        [0, 1, 2, 3].map(|j| {
            let normed = self.norm.map_or(features[j], |norm| norm.apply(rec, features[j], Element::F32));
            let projected = self.projects[j].apply(rec, "projected", normed, Element::F32, Default::default());
            rec.observe(&format!("{tap}/proj{j}"), projected.tensor);
            let mut map = FeatureMap::new(projected, size);
            if self.placed {
                map = map.resized(rec, "placed", size, Some(positions));
            }
            let map = match j {
                0 | 1 => map.spread(rec, "level", SIDES[j], &self.spread[j].0, self.spread[j].1),
                3 => self.reduce.record(rec, "level", map, ConvolutionOptions::default()),
                _ => map,
            };
            rec.observe(&format!("{tap}/resize{j}"), map.rows.tensor);
            let layer = self.layers[j].record(rec, "layer", map, ConvolutionOptions::default());
            rec.observe(&format!("{tap}/rn{j}"), layer.rows.tensor);
            layer
        })
    }
}
