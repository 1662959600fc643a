use super::transformer::{OutLayer, Transformer, Views};
use crate::{
    Result,
    gpu::{Element, Recorder, Run, Tensor},
    ops::{KvPool, ParameterLayout, Parameters, Rows, place_groups},
    stages::{BackboneArchitecture, DepthFeatures, Reference, ViewGrid},
    types::{Camera, relative_encoding},
};

pub struct DepthBackbone {
    transformer: Transformer,
    alternates: bool,
}

impl DepthBackbone {
    pub fn new(p: &mut ParameterLayout, a: &BackboneArchitecture) -> Self {
        Self { transformer: Transformer::new(p, a), alternates: a.alternates() }
    }

    pub fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor> {
        self.transformer.special.inputs(rec, grid, cameras)
    }

    /// `images` are normalized, `[views, 3, height, width]` f32.
    pub fn record(
        &self,
        rec: &mut Recorder,
        images: Tensor,
        inputs: &[Tensor],
        grid: ViewGrid,
        reference: Reference,
    ) -> DepthFeatures {
        let (mut layers, mut last) = (Vec::new(), None);
        let views = Views { grid, reference, pool: KvPool::ALL };
        self.transformer.record(rec, images, inputs, views, |rec, layer, out| {
            layers.push(self.feature(rec, layer, out, grid));
            last = Some(out);
        });
        let cameras = last.filter(|_| self.alternates).map(|last| camera_features(rec, last, grid));
        DepthFeatures { layers, cameras }
    }

    fn feature(&self, rec: &mut Recorder, layer: usize, out_layer: OutLayer, grid: ViewGrid) -> Rows {
        let OutLayer { local, global, leading } = out_layer;
        let (width, patches) = (global.width, grid.patches());
        let halves = if self.alternates { 2 } else { 1 };
        let out = Rows::scratch(rec, "feature", grid.tokens(), halves * width, Element::F32);
        let last = (halves - 1) * width;
        let group = [leading, patches, leading + patches];
        if self.alternates {
            place_groups(rec, local, group, out, 0);
        }
        match self.transformer.final_norm {
            Some(norm) => norm.record(rec, global, None, out.columns(last, width), [leading, patches]),
            None => place_groups(rec, global, group, out, last),
        }
        rec.observe(&format!("bb/feat{layer}"), out.tensor);
        out
    }

    pub fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        cameras: Option<&[Camera]>,
        parameters: &Parameters,
    ) -> Result<()> {
        let poses = cameras.map(relative_encoding).transpose()?;
        self.transformer.special.write(run, inputs, grid, poses.as_deref(), parameters)
    }
}

/// First special tokens.
fn camera_features(rec: &mut Recorder, OutLayer { local, global, leading }: OutLayer, grid: ViewGrid) -> Rows {
    let out = Rows::scratch(rec, "cameras", grid.views, 2 * global.width, Element::F32);
    for (half, rows) in [local, global].into_iter().enumerate() {
        place_groups(rec, rows, [0, 1, leading + grid.patches()], out, half * global.width);
    }
    rec.observe("bb/cam_feat", out.tensor);
    out
}
