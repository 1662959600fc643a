use crate::{
    Error, Result,
    gpu::{Limits, Plan, Recorder},
    ops::{Arithmetic, ParameterLayout, Rows},
    reconstruct::{Inputs, Ratio, SelectedTokens, TokenSampling, TokenSelection, grid, no_camera_encoder},
    stages::{DepthArchitecture, DepthFeatures, DepthStages, Reference, ViewGrid, heads::HeadTensors},
};

/// Depth network parameters.
pub struct DepthNetwork {
    pub(super) architecture: DepthArchitecture,
    pub(super) parameters: ParameterLayout,
    pub(super) stages: DepthStages,
}

/// Parameters of a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthShape {
    /// Views and patches.
    pub grid: ViewGrid,
    /// Whether cameras are known.
    pub cameras: bool,
    /// Reference view.
    pub reference: Reference,
    /// Number of patches kept.
    pub tokens: usize,
    /// Their selection.
    pub kept: TokenSampling,
    /// Whether the last layer's features are an output.
    pub keeps_features: bool,
}

/// Inputs and outputs.
pub struct DepthTensors {
    pub(super) inputs: Inputs,
    pub(super) heads: HeadTensors,
    pub(super) selected: SelectedTokens,
    pub(super) features: Option<Rows>,
}

impl DepthNetwork {
    /// Lays out a network without a device; heads are always f32.
    pub fn new(architecture: &DepthArchitecture, limits: &Limits, arithmetic: Arithmetic) -> Self {
        let mut parameters = ParameterLayout::new(limits, arithmetic);
        let stages = DepthStages::new(&mut parameters, architecture);
        Self { architecture: architecture.clone(), parameters, stages }
    }

    /// Weight bytes on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.parameters.bytes()
    }

    /// Returns the shape for `views` images of `[width, height]` pixels.
    pub fn shape(
        &self,
        views: usize,
        [width, height]: [u32; 2],
        ratio: Ratio,
        selection: &TokenSelection,
        cameras: bool,
        reference: Option<usize>,
    ) -> Result<DepthShape> {
        let a = &self.architecture;
        let grid = grid(a.backbone.patch_size, views, width as usize, height as usize)?;
        if cameras && a.backbone.camera.is_none() {
            return Err(Error::argument("cameras", "some", no_camera_encoder(&a.name)));
        }
        let reference = match reference {
            Some(view) if view >= views => {
                return Err(Error::argument("reference view", view, format!("below {views}")));
            }
            Some(view) => Reference::View(view),
            None if views > 2 && a.backbone.chooses_reference() => Reference::Balanced,
            None => Reference::View(0),
        };
        let (tokens, kept) = TokenSampling::of(grid, ratio, selection)?;
        Ok(DepthShape { grid, cameras, reference, tokens, kept, keeps_features: false })
    }

    /// Records a plan.
    pub fn record(&self, rec: &mut Recorder, shape: DepthShape) -> DepthTensors {
        let DepthShape { grid, tokens, kept, .. } = shape;
        let (inputs, features) = self.record_features(rec, shape);
        let heads = rec.scope("heads", |rec| self.stages.heads.record(rec, &features, grid));
        let deepest = *features.layers.last().expect("a network has output layers");
        let selected = kept.record(rec, self.parameters.nearest(), deepest, grid, tokens);
        let features = shape.keeps_features.then_some(deepest);
        features.iter().for_each(|features| rec.output(features.tensor));
        DepthTensors { inputs, heads, selected, features }
    }

    pub(super) fn record_features(&self, rec: &mut Recorder, shape: DepthShape) -> (Inputs, DepthFeatures) {
        let DepthShape { grid, cameras, reference, .. } = shape;
        let images = rec.input::<f32>("images", grid.values());
        let backbone = self.stages.backbone.inputs(rec, grid, cameras);
        let features =
            rec.scope("backbone", |rec| self.stages.backbone.record(rec, images, &backbone, grid, reference));
        (Inputs { images, backbone }, features)
    }

    /// Plans without a device.
    pub fn plan(&self, limits: &Limits, shape: DepthShape) -> Result<(Plan, DepthTensors)> {
        let mut rec = Recorder::new(limits);
        let tensors = self.record(&mut rec, shape);
        Ok((rec.finish()?, tensors))
    }
}
