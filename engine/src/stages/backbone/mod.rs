//! Backbones: from the pixels of all views to tokens. The rest of the network knows a backbone as [`Backbone`] alone; each has a
//! folder here, and a line in [`backbone`].

mod da3;

pub use da3::{DepthBackbone, interpolate_positions, rotary_tables};

use super::{Architecture, ViewGrid};
use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    ops::{ParameterLayout, Parameters, Rows},
    types::Camera,
};

/// A network from pixels to one set of tokens for each out layer.
pub trait Backbone: Send + Sync {
    /// Tensors that the host writes beside the pixels, in an order of the backbone's own.
    fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor>;

    /// Records the backbone for `images` `[views, 3, height, width]` f32, RGB in 0..1. Returns the tokens of all views for each out
    /// layer, f32, deepest first. Attention across views pools the keys of `pool` x `pool` patches.
    fn record(&self, rec: &mut Recorder, images: Tensor, inputs: &[Tensor], grid: ViewGrid, pool: usize) -> Vec<Rows>;

    /// Writes the inputs of a run. Cameras are given where the inputs were made for them, in the network's unit of length.
    ///
    /// # Errors
    /// A transfer that fails, or a camera that cannot be used.
    fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        cameras: Option<&[Camera]>,
        parameters: &Parameters,
    ) -> Result<()>;
}

/// The backbone of an architecture, which declares its parameters.
pub fn backbone(p: &mut ParameterLayout, a: &Architecture) -> Box<dyn Backbone> {
    Box::new(da3::Da3::new(p, a))
}
