//! The network: from pixels to what the heads leave for the host.

use crate::{
    Error, Result,
    gpu::{Limits, Plan, Recorder, Tensor},
    ops::{Arithmetic, ParameterLayout},
    reconstruct::grid,
    stages::{DepthArchitecture, DepthStages, Reference, ViewGrid, heads::HeadTensors},
};

/// A network's parameters, laid out for a device.
pub struct DepthNetwork {
    pub(super) architecture: DepthArchitecture,
    pub(super) parameters: ParameterLayout,
    pub(super) stages: DepthStages,
}

/// Everything that decides a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DepthShape {
    /// Views and their patches.
    pub grid: ViewGrid,
    /// Cameras are given.
    pub cameras: bool,
    /// The view that the world is about.
    pub reference: Reference,
}

/// The tensors that go in and out of a plan.
pub struct DepthTensors {
    /// `[views, 3, height, width]` f32, normalised.
    pub(super) images: Tensor,
    pub(super) backbone: Vec<Tensor>,
    pub(super) heads: HeadTensors,
}

impl DepthNetwork {
    /// Lays out a network; needs no device. Its heads compute in f32 whatever the arithmetic.
    pub fn new(architecture: &DepthArchitecture, limits: &Limits, arithmetic: Arithmetic) -> Self {
        let mut parameters = ParameterLayout::new(limits, arithmetic);
        let stages = DepthStages::new(&mut parameters, architecture);
        Self { architecture: architecture.clone(), parameters, stages }
    }

    /// Bytes of the weights on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.parameters.bytes()
    }

    /// The shape of `views` pictures of `[width, height]` pixels: `cameras` are given, or the world is about the view `reference`, else the
    /// network's choice: of three and more views the one that is nearest to the middle of what all are like, else the first.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub fn shape(
        &self,
        views: usize,
        [width, height]: [u32; 2],
        cameras: bool,
        reference: Option<usize>,
    ) -> Result<DepthShape> {
        let (a, multi_view) = (&self.architecture, self.architecture.multi_view());
        let grid = grid(a.backbone.patch, views, width as usize, height as usize)?;
        if cameras && !multi_view {
            return Err(Error::argument("cameras", "some", format!("none: {} knows no cameras", a.name)));
        }
        let reference = match reference {
            Some(view) if view >= views => {
                return Err(Error::argument("reference view", view, format!("below {views}")));
            }
            Some(view) => Reference::View(view),
            None if views > 2 && multi_view => Reference::Balanced,
            None => Reference::View(0),
        };
        Ok(DepthShape { grid, cameras, reference })
    }

    /// Records a plan for a shape.
    pub fn record(&self, rec: &mut Recorder, DepthShape { grid, cameras, reference }: DepthShape) -> DepthTensors {
        let images = rec.input::<f32>("images", grid.values());
        let backbone = self.stages.backbone.inputs(rec, grid, cameras);
        let features =
            rec.scope("backbone", |rec| self.stages.backbone.record(rec, images, &backbone, grid, reference));
        let heads = rec.scope("heads", |rec| self.stages.heads.record(rec, &features, grid));
        DepthTensors { images, backbone, heads }
    }

    /// Plans a shape; needs no device.
    ///
    /// # Errors
    /// [`Error::Memory`] where a device of these limits cannot hold or bind a tensor.
    pub fn plan(&self, limits: &Limits, shape: DepthShape) -> Result<(Plan, DepthTensors)> {
        let mut rec = Recorder::new(limits);
        let tensors = self.record(&mut rec, shape);
        Ok((rec.finish()?, tensors))
    }
}
