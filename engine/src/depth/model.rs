use super::{
    DepthNetwork, DepthShape, DepthTensors,
    output::{DepthPrediction, read},
};
use crate::{
    Result,
    features::PixelValues,
    gpu::{Arena, Device, Plan, Progress, Recorder, Run},
    ops::{Arithmetic, Parameters, Rows},
    reconstruct::{Inputs, Ratio, TokenSelection, check_cameras, planar, size_of},
    stages::{DepthArchitecture, Family},
    tune::KernelChoice,
    types::{Camera, Image},
    weights::DepthCheckpoint,
};
use std::ops::ControlFlow;

const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// A depth network on a device.
pub struct DepthModel {
    device: Device,
    network: DepthNetwork,
    parameters: Parameters,
    arena: Arena,
}

/// Depth options.
#[derive(Clone, Debug)]
pub struct DepthOptions {
    /// Known cameras, at image size.
    pub cameras: Option<Vec<Camera>>,
    /// Reference view without cameras; by default the most typical from three on, else the first.
    pub reference_view: Option<usize>,
    /// Ratio of patches in [`DepthPrediction::scene`].
    pub ratio: Ratio,
    /// Selection of those patches.
    pub token_selection: TokenSelection,
    /// Whether to return [`DepthPrediction::patch_tokens`].
    pub keep_features: bool,
}

impl Default for DepthOptions {
    fn default() -> Self {
        Self {
            cameras: None,
            reference_view: None,
            ratio: Ratio::Fixed(1.0),
            token_selection: TokenSelection::KMEANS,
            keep_features: false,
        }
    }
}

impl DepthModel {
    /// Loads a checkpoint's path, or `seeded:NAME` for random weights.
    ///
    /// # Errors
    /// As [`DepthCheckpoint::open`]; [`crate::Error::Memory`].
    pub fn load(device: &Device, weights: &str) -> Result<Self> {
        let checkpoint = DepthCheckpoint::whole(|heads| DepthCheckpoint::parse(weights, heads))?;
        let KernelChoice { arithmetic, .. } = KernelChoice::of(device, None)?;
        Self::from_checkpoint(device, &checkpoint, arithmetic, |_| ControlFlow::Continue(()))
    }

    /// Loads a checkpoint. Heads are always f32.
    pub fn from_checkpoint(
        device: &Device,
        checkpoint: &DepthCheckpoint,
        arithmetic: Arithmetic,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let network = DepthNetwork::new(checkpoint.architecture(), device.limits(), arithmetic);
        let parameters = network.parameters.load(device, &**checkpoint, progress)?;
        Ok(Self { device: device.clone(), network, parameters, arena: Arena::new(device) })
    }

    /// Architecture.
    pub fn architecture(&self) -> &DepthArchitecture {
        &self.network.architecture
    }

    /// The network, for plans.
    pub fn network(&self) -> &DepthNetwork {
        &self.network
    }

    /// Weight bytes on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.network.weight_bytes()
    }

    /// Estimates depth of images of one size, divisible by the patch.
    pub fn predict(
        &self,
        images: &[Image],
        options: &DepthOptions,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<DepthPrediction> {
        let shape = self.shape(images, options)?;
        let (plan, tensors) = self.network.plan(self.device.limits(), shape)?;
        let (arena, _claim) = self.arena.claimed();
        let mut run = Run::in_arena(&arena, 0, plan, [self.parameters.resident.clone()])?;
        self.write_inputs(&mut run, &tensors, shape, images, options)?;
        let times = run.execute_with(progress)?;
        let (selection, all) = (&options.token_selection, shape.grid.tokens());
        let mut patches = tensors.selected.read(&run, selection, all, shape.tokens)?;
        // Centroids may share a patch.
        patches.iter_mut().for_each(|patches| {
            patches.sort_unstable();
            patches.dedup();
        });
        let bytes = run.plan().arena_bytes() + self.weight_bytes();
        let patch_tokens = match tensors.features {
            Some(Rows { tensor, width, .. }) => PixelValues::of_patches(shape.grid, width, &run.read::<f32>(tensor)?),
            None => Vec::new(),
        };
        Ok(DepthPrediction { patches, patch_tokens, ..read(&run, &tensors.heads, shape.grid, times, bytes)? })
    }

    /// Returns each image's patch tokens of the backbone's last layer, a cell per patch.
    pub fn patch_tokens(
        &self,
        images: &[Image],
        options: &DepthOptions,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Vec<PixelValues>> {
        let shape = self.shape(images, options)?;
        let mut rec = Recorder::new(self.device.limits());
        let (inputs, features) = self.network.record_features(&mut rec, shape);
        let deepest = features.layers.last().expect("a network has output layers");
        rec.output(deepest.tensor);
        let (arena, _claim) = self.arena.claimed();
        let mut run = Run::in_arena(&arena, 0, rec.finish()?, [self.parameters.resident.clone()])?;
        self.write_photos(&mut run, &inputs, shape, images, options)?;
        run.execute_with(progress)?;
        Ok(PixelValues::of_patches(shape.grid, deepest.width, &run.read::<f32>(deepest.tensor)?))
    }

    /// Returns the shape for these options.
    pub fn shape(&self, images: &[Image], options: &DepthOptions) -> Result<DepthShape> {
        let size = size_of(images)?;
        let DepthOptions { ratio, token_selection, cameras, reference_view, .. } = options;
        let posed = cameras.is_some();
        let shape = self.network.shape(images.len(), size, *ratio, token_selection, posed, *reference_view)?;
        cameras.iter().try_for_each(|cameras| check_cameras(cameras, images))?;
        Ok(DepthShape { keeps_features: options.keep_features, ..shape })
    }

    /// Records a plan, optionally observed.
    pub fn record(&self, shape: DepthShape, observe: bool) -> Result<(Plan, DepthTensors)> {
        let mut rec = Recorder::new(self.device.limits());
        if observe {
            rec = rec.observing();
        }
        let tensors = self.network.record(&mut rec, shape);
        Ok((rec.finish()?, tensors))
    }

    /// Allocates a plan.
    pub fn run(&self, plan: Plan) -> Result<Run> {
        Run::with_resident(&self.device, plan, Some(self.parameters.resident.clone()))
    }

    /// Writes the inputs.
    pub fn write_inputs(
        &self,
        run: &mut Run,
        tensors: &DepthTensors,
        shape: DepthShape,
        images: &[Image],
        options: &DepthOptions,
    ) -> Result<()> {
        let pixels = self.write_photos(run, &tensors.inputs, shape, images, options)?;
        tensors.selected.write(run, &options.token_selection, shape.grid.tokens(), shape.tokens)?;
        tensors.heads.write(run, &pixels, &self.parameters)
    }

    /// Returns the pixels as the backbone sees them.
    fn write_photos(
        &self,
        run: &mut Run,
        inputs: &Inputs,
        shape: DepthShape,
        images: &[Image],
        options: &DepthOptions,
    ) -> Result<Vec<f32>> {
        let mut pixels = planar(images);
        let area = pixels.len() / (3 * images.len());
        // VGGT's backbone normalizes.
        let planes = pixels.chunks_mut(area).enumerate().filter(|_| self.architecture().backbone.family == Family::Da3);
        for (i, plane) in planes {
            plane.iter_mut().for_each(|value| *value = (*value - MEAN[i % 3]) / DEVIATION[i % 3]);
        }
        run.write(inputs.images, &pixels)?;
        let cameras = options.cameras.as_deref();
        self.network.stages.backbone.write(run, &inputs.backbone, shape.grid, cameras, &self.parameters)?;
        Ok(pixels)
    }
}
