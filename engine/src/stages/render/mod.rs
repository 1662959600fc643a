//! Gaussian rendering.
//!
//! Rules and constants follow gsplat 1.5.3: results equal blending every Gaussian into every pixel.

mod backward;
mod differentiable;
mod features;
mod flights;
mod frame;
mod intersect;
mod pack;
mod plan_cache;
mod planned;
mod project;
mod range;
mod rasterize;
mod renderer;
mod scene;

use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    kernels::limits::TILE,
    types::Camera,
};

use intersect::TileLists;
use project::Splats;

pub use super::{FrameShape, SceneTensors};
pub use backward::{CAMERA_NUMBERS, Gradients, SplatGradients};
pub use differentiable::{Differentiator, HostGradients, Wanted};
pub(crate) use features::{Lifting, VECTOR, VECTORS_AT_ONCE};
pub use frame::{Depth, RenderOptions, RenderOutput};
pub use pack::PixelLayout;
pub use plan_cache::first_capacity;
pub(crate) use plan_cache::{PlanCache, PlanKey, planned_capacity};
pub use planned::plan_pictures;
pub use project::{CameraRows, camera_rows};
pub use range::{MAX_SIDE, check_camera};
pub use renderer::Renderer;
pub(crate) use scene::used_degree;
pub use scene::{DeviceScene, SceneMemory, SceneSource};

#[derive(Clone, Copy, Debug)]
pub struct RenderOutputs {
    /// `[cameras, height, width, channels]` f32, the requested of RGB, alpha, depth, normals, token
    /// colors; or pixels in a [`PixelLayout`].
    pub frames: Tensor,
    /// `[3]` u32: intersections drawn, needed modulo 2^32, wrapped.
    pub status: Tensor,
}

impl RenderOutputs {
    /// Reads the required capacity, at most 2^32. Redraw if it exceeds the recorded one.
    pub fn needed(&self, run: &Run) -> Result<usize> {
        needed(run, self.status)
    }
}

pub(crate) fn needed(run: &Run, status: Tensor) -> Result<usize> {
    let status: Vec<u32> = run.read(status)?;
    Ok(if status[2] == 0 { status[1] as usize } else { 1 << 32 })
}

/// Inputs of rendering.
#[derive(Clone, Copy)]
pub struct FrameInputs<'a> {
    pub scene: &'a SceneTensors,
    /// Rows of [`camera_rows`].
    pub cameras: Tensor,
    pub shape: FrameShape,
    pub options: &'a RenderOptions,
    /// Most tile intersections.
    pub capacity: usize,
}

impl FrameInputs<'_> {
    pub fn record(self, rec: &mut Recorder) -> RenderOutputs {
        self.record_in(rec, None)
    }

    /// As [`Self::record`], or as pixels for [`Run::present`].
    fn record_in(self, rec: &mut Recorder, layout: Option<PixelLayout>) -> RenderOutputs {
        rec.scope("render", |rec| {
            let (_, lists, mut frames) = self.draw(rec);
            if let Some(layout) = layout {
                frames = pack::record(rec, frames, layout);
                rec.keep(frames);
            } else {
                rec.output(frames);
            }
            rec.output(lists.status);
            RenderOutputs { frames, status: lists.status }
        })
    }

    fn draw(self, rec: &mut Recorder) -> (Splats, TileLists, Tensor) {
        let (splats, lists) = self.intersect(rec);
        let frames = rasterize::record(rec, &splats, &lists, self.shape, self.options);
        (splats, lists, frames)
    }

    fn intersect(self, rec: &mut Recorder) -> (Splats, TileLists) {
        let splats = project::record(rec, self.scene, self.cameras, self.shape, self.options);
        let lists = intersect::record(rec, &splats, self.shape, self.capacity);
        (splats, lists)
    }
}

impl FrameShape {
    /// Shape of one camera's picture.
    pub(crate) fn of(camera: &Camera) -> Self {
        Self { cameras: 1, width: camera.intrinsics.width, height: camera.intrinsics.height }
    }

    pub(crate) fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    fn grid(&self) -> [u32; 2] {
        [self.width.div_ceil(TILE), self.height.div_ceil(TILE)]
    }

    fn tiles(&self) -> usize {
        let [x, y] = self.grid();
        self.cameras * x as usize * y as usize
    }
}
