//! Gaussians to pictures: projection, sort by depth, intersections with tiles, sort by tile, blending front to back.
//!
//! Gaussians are sorted by depth first, so that the intersections, several times as many, are only sorted by tile.
//! Rules and constants are gsplat 1.5.3's: the picture is what blending every Gaussian into every pixel would give.

mod backward;
mod differentiable;
mod flights;
mod frame;
mod intersect;
mod pack;
mod planned;
mod project;
mod range;
mod rasterise;
mod renderer;
mod scene;

use crate::{
    gpu::{Recorder, Tensor},
    kernels::limits::TILE,
};

use intersect::TileLists;
use project::Splats;

pub use super::{FrameShape, SceneGradients, SceneTensors};
pub use backward::{CAMERA_NUMBERS, Gradients, record_with_gradients};
pub use differentiable::{Differentiator, HostGradients, Wanted};
pub use frame::{Depth, Frame, RenderRequest};
pub use pack::PixelLayout;
pub use planned::{first_capacity, plan_pictures};
pub use project::{CameraRows, camera_rows};
pub use range::MAX_SIDE;
pub use renderer::Renderer;
pub use scene::{DeviceScene, SceneMemory, WeakScene};

/// The tensors that [`record`] leaves on the device.
#[derive(Clone, Copy, Debug)]
pub struct RenderOutputs {
    /// `[cameras, height, width, channels]` f32: of red, green, blue (not clamped); alpha; depth; normal x, y, z; token
    /// red, green, blue those asked for. For the host, where no [`RenderRequest::layout`] was given.
    pub frames: Tensor,
    /// The frames in that layout, for other programs on the device.
    pub pixels: Tensor,
    /// `[3]` u32: intersections that were drawn, intersections that there are modulo 2^32, and whether that number
    /// wrapped. The frames hold only where the first two are equal and the third is 0; see [`RenderOutputs::needed`].
    pub status: Tensor,
}

impl RenderOutputs {
    /// How many intersections there are, from the status that was read: draw again with at least that capacity where
    /// it is larger than the one recorded. `None` where they are too many to count.
    pub fn needed(status: &[u32]) -> Option<usize> {
        (status[2] == 0).then_some(status[1] as usize)
    }
}

/// Records the drawing of `scene` by `cameras` (`[shape.cameras]` of [`camera_rows`]), with room for `capacity`
/// intersections of Gaussians with tiles.
pub fn record(
    rec: &mut Recorder,
    scene: &SceneTensors,
    cameras: Tensor,
    shape: FrameShape,
    request: &RenderRequest,
    capacity: usize,
) -> RenderOutputs {
    rec.scope("render", |rec| {
        let (_, lists, frames) = draw(rec, scene, cameras, shape, request, capacity);
        let pixels = pack::record(rec, frames, request.layout.unwrap_or(PixelLayout::RgbaF32));
        match request.layout {
            // Then only the app reads them, on the device.
            Some(_) => rec.keep(pixels),
            None => rec.output(frames),
        }
        rec.output(lists.status);
        RenderOutputs { frames, pixels, status: lists.status }
    })
}

/// Gaussians to frames, with what the way back needs.
fn draw(
    rec: &mut Recorder,
    scene: &SceneTensors,
    cameras: Tensor,
    shape: FrameShape,
    request: &RenderRequest,
    capacity: usize,
) -> (Splats, TileLists, Tensor) {
    let splats = project::record(rec, scene, cameras, shape, request);
    let lists = intersect::record(rec, &splats, shape, capacity);
    let frames = rasterise::record(rec, &splats, &lists, shape, request);
    (splats, lists, frames)
}

impl FrameShape {
    /// Tiles along x and y.
    fn grid(&self) -> [u32; 2] {
        [self.width.div_ceil(TILE), self.height.div_ceil(TILE)]
    }

    /// Tiles of all pictures.
    fn tiles(&self) -> usize {
        let [x, y] = self.grid();
        self.cameras * x as usize * y as usize
    }
}
