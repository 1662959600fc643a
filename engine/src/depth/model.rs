use super::{
    DepthNetwork, DepthShape, DepthTensors,
    output::{Depths, read},
};
use crate::{
    Result,
    gpu::{Arena, Device, Plan, Progress, Recorder, Run},
    ops::{Arithmetic, Parameters},
    reconstruct::{Ratio, Selection, check_cameras, planar, size_of},
    stages::DepthArchitecture,
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

/// Depth request.
#[derive(Clone, Debug)]
pub struct DepthRequest {
    /// Known cameras, at image size.
    pub cameras: Option<Vec<Camera>>,
    /// Reference view without cameras; by default the most typical of three or more, else the
    /// first.
    pub reference: Option<usize>,
    /// Ratio of patches in [`Depths::scene`].
    pub ratio: Ratio,
    /// Selection of those patches.
    pub selection: Selection,
}

impl Default for DepthRequest {
    fn default() -> Self {
        Self { cameras: None, reference: None, ratio: Ratio::Fixed(1.0), selection: Selection::KMEANS }
    }
}

impl DepthModel {
    /// Loads a checkpoint. Heads are always f32.
    pub fn load(
        device: &Device,
        checkpoint: &DepthCheckpoint,
        arithmetic: Arithmetic,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let network = DepthNetwork::new(checkpoint.architecture(), device.limits(), arithmetic);
        let parameters = network.parameters.load(device, checkpoint, progress)?;
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
    pub fn depths(
        &self,
        images: &[Image],
        request: &DepthRequest,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Depths> {
        let shape = self.shape(images, request)?;
        let (plan, tensors) = self.network.plan(self.device.limits(), shape)?;
        let (arena, _claim) = self.arena.claimed();
        let mut run = Run::in_arena(&arena, 0, plan, [self.parameters.resident.clone()])?;
        self.write_inputs(&mut run, &tensors, shape, images, request)?;
        let times = run.execute_with(progress)?;
        let mut patches = match (tensors.chosen, tensors.indices) {
            (Some(chosen), _) => Some(run.read(chosen)?),
            (None, Some(_)) => Some(request.selection.indices(shape.grid.tokens(), shape.tokens)),
            (None, None) => None,
        };
        // Centroids may share a patch.
        patches.iter_mut().for_each(|patches| {
            patches.sort_unstable();
            patches.dedup();
        });
        let bytes = run.plan().arena_bytes() + self.weight_bytes();
        Ok(Depths { patches, ..read(&run, &tensors.heads, shape.grid, times, bytes)? })
    }

    /// Returns the shape of a request.
    pub fn shape(&self, images: &[Image], request: &DepthRequest) -> Result<DepthShape> {
        let size = size_of(images)?;
        let chosen = (request.ratio, &request.selection);
        let shape = self.network.shape(images.len(), size, chosen, request.cameras.is_some(), request.reference)?;
        request.cameras.iter().try_for_each(|cameras| check_cameras(cameras, images))?;
        Ok(shape)
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
        request: &DepthRequest,
    ) -> Result<()> {
        let mut pixels = planar(images);
        let area = pixels.len() / (3 * images.len());
        for (i, plane) in pixels.chunks_mut(area).enumerate() {
            plane.iter_mut().for_each(|value| *value = (*value - MEAN[i % 3]) / DEVIATION[i % 3]);
        }
        run.write(tensors.images, &pixels)?;
        if let Some(indices) = tensors.indices {
            run.write(indices, &request.selection.indices(shape.grid.tokens(), shape.tokens))?;
        }
        let cameras = request.cameras.as_deref();
        self.network.stages.backbone.write(run, &tensors.backbone, shape.grid, cameras, &self.parameters)?;
        tensors.heads.write(run, &pixels)
    }
}
