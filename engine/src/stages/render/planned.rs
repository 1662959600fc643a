use super::{
    CameraRows, DeviceScene, Frame, FrameShape, RenderOutputs, RenderRequest, SceneTensors, flights::pictures_together,
    record,
};
use crate::{
    Result,
    gpu::{Arena, Limits, Plan, Recorder, Run, Tensor},
};

/// Batch that fills a GPU; CPUs cache best with one.
const GPU_TOGETHER: usize = 8;

#[derive(Clone, Copy, PartialEq)]
pub(super) struct Key {
    pub shape: FrameShape,
    pub request: RenderRequest,
    pub turn: usize,
}

pub(super) struct Planned {
    pub key: Key,
    pub scene: SceneTensors,
    pub capacity: usize,
    pub run: Run,
    pub cameras: Tensor,
    pub outputs: RenderOutputs,
}

/// Plans the first batch of [`Renderer::render_each`](super::Renderer::render_each), without a
/// device.
pub fn plan_pictures(
    limits: &Limits,
    scene: &SceneTensors,
    [width, height]: [u32; 2],
    request: &RenderRequest,
) -> Result<Plan> {
    let cameras = pictures_together(together(limits), scene.len, [width, height]);
    let shape = FrameShape { cameras, width, height };
    let mut rec = Recorder::new(limits);
    let rows = rec.input::<CameraRows>("cameras", cameras);
    let capacity = planned_capacity(limits, first_capacity(scene.len), shape);
    record(&mut rec, scene, rows, shape, request, capacity);
    rec.finish()
}

pub(super) fn together(limits: &Limits) -> usize {
    if limits.cpu { 1 } else { GPU_TOGETHER }
}

/// Initial capacity, a few tiles per Gaussian.
pub fn first_capacity(gaussians: usize) -> usize {
    (4 * gaussians).max(1 << 16)
}

pub(super) fn planned_capacity(limits: &Limits, each: usize, shape: FrameShape) -> usize {
    each.saturating_mul(shape.cameras).min(limits.max_binding_bytes as usize / 4)
}

impl Planned {
    pub fn new(arena: &Arena, scene: &DeviceScene, key: Key, capacity: usize) -> Result<Self> {
        let mut rec = Recorder::new(arena.device().limits());
        let cameras = rec.input::<CameraRows>("cameras", key.shape.cameras);
        let outputs = record(&mut rec, scene.tensors(), cameras, key.shape, &key.request, capacity);
        let run = Run::in_arena(arena, key.turn, rec.finish()?, [scene.resident().clone()])?.in_flight()?;
        Ok(Self { key, scene: *scene.tensors(), capacity, run, cameras, outputs })
    }

    pub fn needed(&self) -> Result<usize> {
        let status: Vec<u32> = self.run.read(self.outputs.status)?;
        Ok(RenderOutputs::needed(&status).unwrap_or(1 << 32))
    }

    /// `None` if over capacity.
    pub fn frames(&self) -> Result<Option<Vec<Frame>>> {
        if self.needed()? > self.capacity { Ok(None) } else { self.read().map(Some) }
    }

    pub fn read(&self) -> Result<Vec<Frame>> {
        let values: Vec<f32> = self.run.read(self.outputs.frames)?;
        let FrameShape { cameras, width, height } = self.key.shape;
        let frame = |values| Frame::from_channels(width, height, values, &self.key.request);
        if cameras == 1 {
            return Ok(vec![frame(values)]);
        }
        Ok(values.chunks_exact(values.len() / cameras).map(|values| frame(values.to_vec())).collect())
    }
}
