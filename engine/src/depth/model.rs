//! A depth network on a device.

use super::output::{Depths, read};
use crate::{
    Error, Result,
    gpu::{Arena, Device, Plan, Progress, Recorder, Run, Tensor},
    ops::{Arithmetic, ParameterLayout, Parameters},
    reconstruct::{check_cameras, grid, planar, size_of},
    stages::{DepthArchitecture, DepthStages, Reference, ViewGrid, heads::HeadTensors},
    types::{Camera, Image},
    weights::DepthCheckpoint,
};
use std::ops::ControlFlow;

/// The mean of each colour over ImageNet, and its deviation, by which pictures are normalised.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// A network with its weights on a device.
pub struct DepthModel {
    device: Device,
    architecture: DepthArchitecture,
    layout: ParameterLayout,
    stages: DepthStages,
    parameters: Parameters,
    arena: Arena,
}

/// A request for depth.
#[derive(Clone, Debug, Default)]
pub struct DepthRequest {
    /// Known cameras of all views, of the images' own size, or none.
    pub cameras: Option<Vec<Camera>>,
    /// The view that the world is about, where no cameras are known; else the network's own choice: of three and more views the one that
    /// is nearest to the middle of what all are like, else the first.
    pub reference: Option<usize>,
}

/// Everything that decides a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthShape {
    /// Views and their patches.
    pub grid: ViewGrid,
    /// Whether cameras are given.
    pub cameras: bool,
    /// The view that the world is about.
    pub reference: Reference,
}

/// The tensors that go in and out of a plan.
pub struct DepthTensors {
    images: Tensor,
    backbone: Vec<Tensor>,
    /// The tensors of the heads.
    pub heads: HeadTensors,
}

impl DepthModel {
    /// Loads a checkpoint onto a device. `progress` gets the share that is done and may stop it. Heads compute in f32 whatever the
    /// arithmetic.
    ///
    /// # Errors
    /// Where the device has too little memory or the checkpoint cannot be read; [`Error::Cancelled`].
    pub fn load(
        device: &Device,
        checkpoint: &DepthCheckpoint,
        arithmetic: Arithmetic,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let architecture = checkpoint.architecture().clone();
        let mut layout = ParameterLayout::new(device.limits(), arithmetic);
        let stages = DepthStages::new(&mut layout, &architecture);
        let parameters =
            layout.load(device, &|name: &str, out: &mut [f32]| checkpoint.read_f32(name, out), progress)?;
        let (device, arena) = (device.clone(), Arena::new(device));
        Ok(Self { device, architecture, layout, stages, parameters, arena })
    }

    /// The network's architecture.
    pub fn architecture(&self) -> &DepthArchitecture {
        &self.architecture
    }

    /// Bytes of the weights on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.layout.bytes()
    }

    /// Finds depth and what the network says beside it in images of one size, whose sides are multiples of the patch.
    ///
    /// # Errors
    /// [`Error::Argument`] for images or a request that cannot be used, [`Error::Memory`] where the device has too little (nothing was
    /// submitted then), [`Error::Cancelled`] where `progress` asked to stop.
    pub fn depths(
        &self,
        images: &[Image],
        request: &DepthRequest,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Depths> {
        let shape = self.shape(images, request)?;
        let (plan, tensors) = self.record(shape, false)?;
        let (arena, _claim) = self.arena.claimed();
        let mut run = Run::in_arena(&arena, 0, plan, [self.parameters.resident.clone()])?;
        self.write_inputs(&mut run, &tensors, shape, images, request)?;
        let times = run.execute_with(progress)?;
        read(&run, &tensors.heads, shape.grid, times, run.plan().arena_bytes() + self.weight_bytes())
    }

    /// The shape of a request for these images.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub fn shape(&self, images: &[Image], request: &DepthRequest) -> Result<DepthShape> {
        let [width, height] = size_of(images)?;
        let grid = grid(self.architecture.backbone.patch, images.len(), width as usize, height as usize)?;
        if let Some(cameras) = &request.cameras {
            if !self.architecture.multi_view() {
                let expected = format!("none: {} knows no cameras", self.architecture.name);
                return Err(Error::argument("cameras", cameras.len(), expected));
            }
            check_cameras(cameras, images)?;
        }
        if let Some(view) = request.reference.filter(|&view| view >= images.len()) {
            return Err(Error::argument("reference view", view, format!("below {}", images.len())));
        }
        let reference = match request.reference {
            Some(view) => Reference::View(view),
            None if images.len() > 2 && self.architecture.multi_view() => Reference::Balanced,
            None => Reference::View(0),
        };
        Ok(DepthShape { grid, cameras: request.cameras.is_some(), reference })
    }

    /// Records a plan for a shape, observing its intermediate tensors where asked.
    ///
    /// # Errors
    /// [`Error::Memory`] where the device cannot hold or bind a tensor.
    pub fn record(&self, shape: DepthShape, observe: bool) -> Result<(Plan, DepthTensors)> {
        let mut rec = Recorder::new(self.device.limits());
        if observe {
            rec = rec.observing();
        }
        let DepthShape { grid, cameras, reference } = shape;
        let images = rec.input::<f32>("images", grid.values());
        let backbone = self.stages.backbone.inputs(&mut rec, grid, cameras);
        let features =
            rec.scope("backbone", |rec| self.stages.backbone.record(rec, images, &backbone, grid, reference));
        let heads = rec.scope("heads", |rec| self.stages.heads.record(rec, &features, grid));
        Ok((rec.finish()?, DepthTensors { images, backbone, heads }))
    }

    /// Allocates a plan of this model.
    ///
    /// # Errors
    /// [`Error::Memory`] where the device has too little.
    pub fn run(&self, plan: Plan) -> Result<Run> {
        Run::with_resident(&self.device, plan, Some(self.parameters.resident.clone()))
    }

    /// Writes everything that a run of this shape reads.
    ///
    /// # Errors
    /// Where a transfer fails or the cameras cannot be used.
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
        let cameras = request.cameras.as_deref();
        self.stages.backbone.write(run, &tensors.backbone, shape.grid, cameras, &self.parameters)?;
        tensors.heads.write(run, &pixels)
    }
}
