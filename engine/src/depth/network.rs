//! The network: from pixels to what the heads leave for the host.

use crate::{
    Error, Result,
    gpu::{Limits, Plan, Recorder, Tensor},
    ops::{Arithmetic, ParameterLayout},
    reconstruct::{Kept, Ratio, Selection, grid},
    stages::{DepthArchitecture, DepthStages, Reference, ViewGrid, cluster, heads::HeadTensors},
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
    /// Patches that stand for all.
    pub tokens: usize,
    /// How those are found.
    pub kept: Kept,
}

/// The tensors that go in and out of a plan.
pub struct DepthTensors {
    /// `[views, 3, height, width]` f32, normalised.
    pub(super) images: Tensor,
    pub(super) backbone: Vec<Tensor>,
    pub(super) heads: HeadTensors,
    /// First centroids' patches, or the patches themselves; absent where all are kept.
    pub(super) indices: Option<Tensor>,
    /// `[tokens]` u32: the patches that k-means chose, where it did.
    pub(super) chosen: Option<Tensor>,
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

    /// The shape of `views` pictures of `[width, height]` pixels, of whose patches some are `chosen`: `cameras` are given, or the world is
    /// about the view `reference`, else the network's choice: of three and more views the one that is nearest to the middle of what all are
    /// like, else the first.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub fn shape(
        &self,
        views: usize,
        [width, height]: [u32; 2],
        chosen: (Ratio, &Selection),
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
        let (tokens, kept) = Kept::of(grid, chosen)?;
        Ok(DepthShape { grid, cameras, reference, tokens, kept })
    }

    /// Records a plan for a shape.
    pub fn record(&self, rec: &mut Recorder, shape: DepthShape) -> DepthTensors {
        let DepthShape { grid, cameras, reference, tokens, kept } = shape;
        let images = rec.input::<f32>("images", grid.values());
        let backbone = self.stages.backbone.inputs(rec, grid, cameras);
        let features =
            rec.scope("backbone", |rec| self.stages.backbone.record(rec, images, &backbone, grid, reference));
        let heads = rec.scope("heads", |rec| self.stages.heads.record(rec, &features, grid));
        let indices = (kept != Kept::All).then(|| rec.input::<u32>("indices", tokens));
        let chosen = match (indices, kept, features.layers.last()) {
            (Some(initial), Kept::Kmeans(rounds), Some(deepest)) => Some(rec.scope("cluster", |rec| {
                cluster::record(rec, self.parameters.nearest(), *deepest, initial, tokens, rounds)
            })),
            _ => None,
        };
        chosen.into_iter().for_each(|chosen| rec.output(chosen));
        DepthTensors { images, backbone, heads, indices, chosen }
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
