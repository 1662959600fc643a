use super::{BlockLayout, BlockOptions, MAX_VIEWS, SelectedTokens, Shape};
use crate::{
    Result,
    gpu::{Element, Limits, Plan, Recorder, ResidentLayout, Run, Tensor},
    ops::{Arithmetic, ParameterLayout, Rows, join_columns},
    stages::{Architecture, Stages, ViewGrid, render::SceneTensors},
    types::Scene,
    weights::Checkpoint,
};

/// Parameters of a network.
pub struct Network {
    pub(super) architecture: Architecture,
    pub(super) parameters: ParameterLayout,
    pub(super) stages: Stages,
}

/// Inputs and outputs.
#[derive(Clone, Debug)]
pub struct Tensors {
    pub(super) inputs: Inputs,
    pub(super) choice: Choice,
    scene: SceneTensors,
}

#[derive(Clone, Debug)]
pub(crate) struct Inputs {
    /// `[views, 3, height, width]` f32: RGB in 0..1, or normalized for depth networks.
    pub images: Tensor,
    pub backbone: Vec<Tensor>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Choice {
    /// `[1]` f32 scene scale.
    pub scene_scale: Option<Tensor>,
    pub selected: SelectedTokens,
}

#[derive(Clone, Debug)]
pub(super) struct FeatureTensors {
    /// `[views, 3, height, width]` f32, RGB in 0..1.
    pub images: Tensor,
    /// f32, deepest first.
    pub layers: Vec<Rows>,
}

impl FeatureTensors {
    pub fn lay_out(layout: &mut ResidentLayout, architecture: &Architecture, grid: ViewGrid) -> Self {
        let (tokens, width) = (grid.tokens(), architecture.width);
        let mut layer = |_| Rows::new(layout.add::<f32>(tokens * width), tokens, width);
        let layers = architecture.out_layers.iter().map(&mut layer).collect();
        Self { images: layout.add::<f32>(grid.values()), layers }
    }
}

/// A plan to device Gaussians.
pub struct NetworkPlan {
    /// Commands.
    pub plan: Plan,
    /// Inputs and outputs.
    pub tensors: Tensors,
    /// Memory of the Gaussians.
    pub layout: ResidentLayout,
}

impl NetworkPlan {
    /// Arena and Gaussian bytes.
    pub fn bytes(&self) -> u64 {
        self.plan.arena_bytes() + self.layout.bytes()
    }
}

impl Network {
    /// Lays out a network without a device.
    pub fn new(architecture: &Architecture, limits: &Limits, arithmetic: Arithmetic) -> Self {
        Self::laid_out(architecture, ParameterLayout::new(limits, arithmetic))
    }

    /// Lays out a checkpoint's network without a device.
    pub fn of(checkpoint: &Checkpoint, limits: &Limits, arithmetic: Arithmetic) -> Result<Self> {
        checkpoint.suits(arithmetic)?;
        let q8 = checkpoint.q8_names().map(String::from);
        let parameters = ParameterLayout::new(limits, arithmetic).with_q8(q8);
        Ok(Self::laid_out(checkpoint.architecture(), parameters))
    }

    fn laid_out(architecture: &Architecture, mut parameters: ParameterLayout) -> Self {
        let stages = Stages::new(&mut parameters, architecture);
        Self { architecture: architecture.clone(), parameters, stages }
    }

    /// Weight bytes on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.parameters.bytes()
    }

    /// Records the forward pass to host Gaussians.
    pub fn record(&self, rec: &mut Recorder, shape: Shape) -> Tensors {
        let into = SceneTensors::output(rec, self.gaussians_of(shape), self.architecture.sh_degree as u32);
        self.record_into(rec, shape, into)
    }

    /// Plans the forward pass to device Gaussians, without a device.
    pub fn plan(&self, limits: &Limits, shape: Shape) -> Result<NetworkPlan> {
        let mut layout = ResidentLayout::new(limits);
        let into = SceneTensors::lay_out(&mut layout, self.gaussians_of(shape), self.architecture.sh_degree as u32);
        let mut rec = Recorder::new(limits);
        let tensors = self.record_into(&mut rec, shape, into);
        Ok(NetworkPlan { plan: rec.finish()?, tensors, layout })
    }

    /// Lays out the blocks of `views` views in passes of this `shape`, by default as large as
    /// [`MAX_VIEWS`] and the device's memory allow.
    ///
    /// # Errors
    /// Those of `shape`; [`crate::Error::Argument`] for invalid `blocks`.
    pub fn block_layout(
        &self,
        limits: &Limits,
        views: usize,
        blocks: BlockOptions,
        shape: impl Fn(usize) -> Result<Shape>,
    ) -> Result<BlockLayout> {
        let bytes = |size: usize| -> Result<u64> {
            let layout = BlockLayout::new(views, size, blocks.overlap)?;
            let shape = shape(size)?;
            let plan = self.plan(limits, shape)?;
            let (_, joined) = layout.scene(limits, shape, *plan.tensors.scene());
            Ok(self.weight_bytes() + plan.bytes() + joined)
        };
        let fits = |size: usize| bytes(size).is_ok_and(|bytes| bytes <= limits.memory_bytes);
        let most = views.min(MAX_VIEWS);
        let size = match blocks.size {
            Some(size) => size,
            None if most <= BlockLayout::SMALLEST || fits(most) => most,
            None => {
                let (mut size, mut too_large) = (BlockLayout::SMALLEST, most);
                while too_large - size > 1 {
                    let middle = (size + too_large) / 2;
                    *(if fits(middle) { &mut size } else { &mut too_large }) = middle;
                }
                size
            }
        };
        BlockLayout::checked(views, size, blocks.overlap, shape)
    }

    /// Number of Gaussians.
    pub fn gaussians_of(&self, shape: Shape) -> usize {
        shape.tokens * self.architecture.gaussians_per_token
    }

    fn record_into(&self, rec: &mut Recorder, shape: Shape, scene: SceneTensors) -> Tensors {
        let inputs = self.inputs(rec, shape);
        let layers = self.features(rec, shape, &inputs);
        let choice = self.record_decoding(rec, shape, &FeatureTensors { images: inputs.images, layers }, &scene);
        Tensors { inputs, choice, scene }
    }

    pub(super) fn record_features(&self, rec: &mut Recorder, shape: Shape, into: &FeatureTensors) -> Inputs {
        let inputs = self.inputs(rec, shape);
        rec.copy(inputs.images, into.images);
        let layers = self.features(rec, shape, &inputs);
        layers.into_iter().zip(&into.layers).for_each(|(layer, kept)| rec.copy(layer.tensor, kept.tensor));
        inputs
    }

    pub(super) fn record_decoding(
        &self,
        rec: &mut Recorder,
        shape: Shape,
        features: &FeatureTensors,
        scene: &SceneTensors,
    ) -> Choice {
        let scene_scale = rec.input::<f32>("unit", 1);
        let (choice, tokens) = self.head_tokens(rec, shape, features);
        rec.scope("gaussians", |rec| self.stages.gaussians.record(rec, tokens, scene_scale, scene));
        Choice { scene_scale: Some(scene_scale), ..choice }
    }

    pub(super) fn record_tokens(
        &self,
        rec: &mut Recorder,
        shape: Shape,
        features: &FeatureTensors,
        into: Tensor,
    ) -> Choice {
        let (choice, tokens) = self.head_tokens(rec, shape, features);
        let joined = join_columns(rec, tokens, Element::F32);
        rec.copy(joined.tensor, into);
        choice
    }

    fn head_tokens(&self, rec: &mut Recorder, shape: Shape, features: &FeatureTensors) -> (Choice, [Rows; 2]) {
        let Shape { grid, tokens, .. } = shape;
        let FeatureTensors { images, layers } = features;
        let selected = shape.kept.record(rec, self.parameters.nearest(), layers[0], grid, tokens);
        let chosen = selected.tensor().map(|indices| (indices, tokens));
        let scene = rec.scope("fuse", |rec| self.stages.fuse.record(rec, layers, chosen));
        let colors = rec.scope("gaussians", |rec| self.stages.gaussians.colors(rec, *images, grid, chosen));
        (Choice { scene_scale: None, selected }, [scene, colors])
    }

    fn inputs(&self, rec: &mut Recorder, shape: Shape) -> Inputs {
        let images = rec.input::<f32>("images", shape.grid.values());
        Inputs { images, backbone: self.stages.backbone.inputs(rec, shape.grid, shape.cameras) }
    }

    fn features(&self, rec: &mut Recorder, shape: Shape, inputs: &Inputs) -> Vec<Rows> {
        let Inputs { images, backbone } = inputs;
        let stage = &self.stages.backbone;
        rec.scope("backbone", |rec| stage.record(rec, *images, backbone, shape.grid, shape.kv_pool))
    }
}

impl Tensors {
    /// Tensors of the Gaussians.
    pub fn scene(&self) -> &SceneTensors {
        &self.scene
    }

    /// Reads the scene of [`Network::record`].
    pub fn read(&self, run: &Run) -> Result<Scene> {
        Ok(Scene {
            means: run.read(self.scene.means)?,
            scales: run.read(self.scene.scales)?,
            quats: run.read(self.scene.quats)?,
            opacities: run.read(self.scene.opacities)?,
            sh_coeffs: run.read(self.scene.sh_coeffs)?,
            sh_degree: self.scene.sh_degree,
            antialiased: false,
        })
    }
}
