//! Backbones: pixels to tokens, behind one trait.

mod da3;

pub use da3::{DepthBackbone, interpolate_positions, rotary_tables};

use super::{Architecture, ViewGrid};
use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    ops::{ParameterLayout, Parameters, Rows},
    types::Camera,
};

/// A network from pixels to tokens per out layer.
pub trait Backbone: Send + Sync {
    /// Allocates host inputs besides pixels.
    fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor>;

    /// Records the backbone for `images` `[views, 3, height, width]` f32, RGB in 0..1. Returns f32
    /// tokens per out layer, deepest first.
    fn record(&self, rec: &mut Recorder, images: Tensor, inputs: &[Tensor], grid: ViewGrid, pool: usize) -> Vec<Rows>;

    /// Writes the inputs, with cameras in network units.
    fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        cameras: Option<&[Camera]>,
        parameters: &Parameters,
    ) -> Result<()>;
}

/// Returns an architecture's backbone.
pub fn backbone(p: &mut ParameterLayout, a: &Architecture) -> Box<dyn Backbone> {
    Box::new(da3::Da3::new(p, a))
}
