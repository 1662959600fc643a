use super::{
    Model, Outputs, Patches, ReconstructOptions, Reconstruction, Shape,
    network::FeatureTensors,
    patches::{all_masked, masked_patches},
    write_choice,
};
use crate::{
    Result,
    features::PixelValues,
    gpu::{Device, Progress, Recorder, Resident, ResidentLayout, Run, StageTimes, Tensor},
    stages::{
        ViewGrid,
        render::{SceneMemory, SceneTensors},
    },
    types::Image,
};
use std::{ops::ControlFlow, sync::Arc};

/// Backbone features, for several scenes.
pub struct BackboneFeatures {
    shape: Shape,
    tensors: FeatureTensors,
    memory: Arc<Resident>,
    scene_scale: f64,
    masked: Option<Vec<bool>>,
    /// Time per stage.
    pub times: StageTimes,
}

impl BackboneFeatures {
    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        self.memory.bytes()
    }

    /// Views and patches.
    pub fn grid(&self) -> ViewGrid {
        self.shape.grid
    }

    /// Values of a patch token.
    pub fn channels(&self) -> usize {
        self.tensors.layers[0].width
    }

    /// Returns each view's patch tokens of the last layer, a cell per patch.
    pub fn patch_tokens(&self) -> Result<Vec<PixelValues>> {
        let values: Vec<f32> = self.memory.read(self.tensors.layers[0].tensor)?;
        Ok(PixelValues::of_patches(self.shape.grid, self.channels(), &values))
    }
}

/// Head inputs on the device.
pub struct SceneTokens {
    memory: Arc<Resident>,
    tensor: Tensor,
    count: usize,
    width: usize,
    scene_scale: f64,
}

impl SceneTokens {
    /// `[count, width]` f32: scene tokens, then colors.
    pub fn tensor(&self) -> Tensor {
        self.tensor
    }

    /// Number of tokens.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Values per token.
    pub fn width(&self) -> usize {
        self.width
    }

    /// See [`ReconstructOptions::scene_scale`].
    pub fn scene_scale(&self) -> f64 {
        self.scene_scale
    }

    fn among(&self, device: &Device, numbers: &[usize]) -> Result<Self> {
        let all: Vec<f32> = self.memory.read(self.tensor)?;
        let rows = numbers.iter().flat_map(|token| &all[token * self.width..(token + 1) * self.width]);
        let mut layout = ResidentLayout::new(device.limits());
        let tensor = layout.add::<f32>(numbers.len() * self.width);
        let memory = Arc::new(Resident::new(device, &layout)?);
        memory.write(tensor, &rows.copied().collect::<Vec<_>>())?;
        Ok(Self { memory, tensor, count: numbers.len(), ..*self })
    }

    /// Memory of the tensor.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.memory
    }
}

impl Model {
    /// Runs the backbone with cameras, scale and pooling of `options`.
    pub fn features(
        &self,
        images: &[Image],
        options: &ReconstructOptions,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<BackboneFeatures> {
        let shape = self.shape(images, options)?;
        self.in_arena(|arena, _| {
            let mut layout = ResidentLayout::new(self.device.limits());
            let tensors = FeatureTensors::lay_out(&mut layout, self.architecture(), shape.grid);
            let mut rec = Recorder::new(self.device.limits());
            let inputs = self.network.record_features(&mut rec, shape, &tensors);
            let memory = Arc::new(Resident::new(&self.device, &layout)?);
            let mut run = Run::in_arena(arena, 0, rec.finish()?, [self.parameters.resident.clone(), memory.clone()])?;
            self.write_photos(&mut run, &inputs, shape, images, options)?;
            let times = run.execute_with(&mut progress)?;
            let masked = masked_patches(shape.grid, images);
            Ok(BackboneFeatures { shape, tensors, memory, scene_scale: options.scale(), masked, times })
        })
    }

    /// Decodes features bit-identically to [`Model::reconstruct_views`], with ratio and selection
    /// of `options`.
    pub fn reconstruct_features(
        &self,
        features: &BackboneFeatures,
        options: &ReconstructOptions,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        let shape = self.shape_of(features, options)?;
        let options = ReconstructOptions { scene_scale: Some(features.scene_scale), ..options.clone() };
        let made = self.in_arena(|arena, _| {
            let mut layout = ResidentLayout::new(self.device.limits());
            let degree = self.architecture().sh_degree as u32;
            let into = SceneTensors::lay_out(&mut layout, self.network.gaussians_of(shape), degree);
            let mut rec = Recorder::new(self.device.limits());
            let choice = self.network.record_decoding(&mut rec, shape, &features.tensors, &into);
            let mut scene = SceneMemory::new(&self.device, &layout, into)?.made_in(arena);
            let memories = [self.parameters.resident.clone(), features.memory.clone(), scene.resident().clone()];
            let mut run = Run::in_arena(arena, 0, rec.finish()?, memories)?;
            let masked = features.masked.as_deref();
            let outputs = Outputs { choice, scene: &mut scene };
            self.decode(&mut run, outputs, shape, &options, masked, &mut progress)
        })?;
        if made.patches.is_empty() {
            return Err(all_masked());
        }
        Ok(Reconstruction { peak_bytes: made.peak_bytes + features.bytes(), ..made })
    }

    /// Fuses features for [`crate::refine::refine_tokens`], with ratio and selection of `options`,
    /// without masked patches.
    pub fn tokens(
        &self,
        features: &BackboneFeatures,
        options: &ReconstructOptions,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<SceneTokens> {
        let shape = self.shape_of(features, options)?;
        let width = self.architecture().width + self.architecture().color_width;
        self.in_arena(|arena, _| {
            let mut layout = ResidentLayout::new(self.device.limits());
            let tensor = layout.add::<f32>(shape.tokens * width);
            let mut rec = Recorder::new(self.device.limits());
            let choice = self.network.record_tokens(&mut rec, shape, &features.tensors, tensor);
            let memory = Arc::new(Resident::new(&self.device, &layout)?);
            let memories = [self.parameters.resident.clone(), features.memory.clone(), memory.clone()];
            let mut run = Run::in_arena(arena, 0, rec.finish()?, memories)?;
            write_choice(&mut run, choice, shape, options)?;
            run.execute_with(&mut progress)?;
            let tokens = SceneTokens { memory, tensor, count: shape.tokens, width, scene_scale: features.scene_scale };
            match Patches::of(&run, choice, shape, options)?.drop_masked(features.masked.as_deref()) {
                Some(unmasked) if unmasked.is_empty() => Err(all_masked()),
                Some(unmasked) => tokens.among(&self.device, &unmasked),
                None => Ok(tokens),
            }
        })
    }

    fn shape_of(&self, features: &BackboneFeatures, options: &ReconstructOptions) -> Result<Shape> {
        let (grid, cameras) = (features.shape.grid, features.shape.cameras);
        let size = [grid.columns, grid.rows].map(|count| (count * grid.patch_size) as u32);
        Shape::new(self.architecture(), grid.views, size, options.ratio, &options.token_selection, cameras)
            .map(|shape| shape.pooled(features.shape.kv_pool))
    }
}
