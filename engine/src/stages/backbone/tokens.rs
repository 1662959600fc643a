use super::{
    features::Features,
    transformer::{Transformer, Views},
};
use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    ops::{KvPool, ParameterLayout, Parameters, Rows},
    stages::{Architecture, Reference, ViewGrid},
    types::{Camera, prior_encoding},
};

/// The backbone of ZipSplat, to tokens of `width`.
pub struct TokenBackbone {
    transformer: Transformer,
    features: Features,
}

impl TokenBackbone {
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        Self { transformer: Transformer::new(p, &a.backbone()), features: Features::new(p, a) }
    }

    pub fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor> {
        self.transformer.special.inputs(rec, grid, cameras)
    }

    /// `images` are `[views, 3, height, width]` f32, RGB in 0..1. Returns f32 tokens per out layer,
    /// deepest first.
    pub fn record(
        &self,
        rec: &mut Recorder,
        images: Tensor,
        inputs: &[Tensor],
        grid: ViewGrid,
        pool: KvPool,
    ) -> Vec<Rows> {
        let (layers, final_norm) = (self.features.layers(), self.transformer.final_norm);
        let mut prepared = Vec::new();
        let views = Views { grid, reference: Reference::View(0), pool };
        self.transformer.record(rec, images, inputs, views, |rec, layer, out| {
            prepared.push(self.features.record(rec, layers - 1 - layer, out, final_norm, grid));
        });
        prepared.reverse();
        prepared
    }

    /// Cameras are in network units.
    pub fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        cameras: Option<&[Camera]>,
        parameters: &Parameters,
    ) -> Result<()> {
        let poses = cameras.map(prior_encoding).transpose()?;
        self.transformer.special.write(run, inputs, grid, poses.as_deref(), parameters)
    }
}
