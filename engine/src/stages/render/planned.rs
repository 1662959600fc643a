use super::{
    CameraRows, DeviceScene, FrameInputs, FrameShape, PixelLayout, PlanKey, RenderOptions, RenderOutput, RenderOutputs,
    SceneTensors, first_capacity, planned_capacity,
};
use crate::{
    Result,
    gpu::{Arena, Limits, Plan, Recorder, Run, Tensor},
};

/// Fills a GPU; CPUs cache best with one.
const PIXELS_TOGETHER: usize = 1 << 20;
const PAIRS_TOGETHER: usize = 1 << 21;
const GPU_TOGETHER: usize = 8;

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Destination {
    /// The host, from a lane of the arena.
    Host(usize),
    /// An application's image or buffer on the device.
    Device(PixelLayout),
}

pub(super) type RenderKey = PlanKey<(RenderOptions, Destination)>;

pub(super) struct RenderPlan {
    key: RenderKey,
    pub scene: SceneTensors,
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
    options: &RenderOptions,
) -> Result<Plan> {
    let cameras = pictures_per_batch(batch_size(limits), scene.len, [width, height]);
    let shape = FrameShape { cameras, width, height };
    let mut rec = Recorder::new(limits);
    let rows = rec.input::<CameraRows>("cameras", cameras);
    let capacity = planned_capacity(limits.max_binding_bytes, first_capacity(scene.len), shape, false);
    FrameInputs { scene, cameras: rows, shape, options, capacity }.record(&mut rec);
    rec.finish()
}

pub(super) fn pictures_per_batch(most: usize, gaussians: usize, [width, height]: [u32; 2]) -> usize {
    let pixels = width as usize * height as usize;
    most.min(PIXELS_TOGETHER / pixels).min(PAIRS_TOGETHER / gaussians.max(1)).max(1)
}

pub(super) fn batch_size(limits: &Limits) -> usize {
    if limits.cpu { 1 } else { GPU_TOGETHER }
}

impl RenderPlan {
    pub fn new(arena: &Arena, scene: &DeviceScene, key: RenderKey, capacity: usize) -> Result<Self> {
        let (options, destination) = key.options;
        let (lane, layout) = match destination {
            Destination::Host(lane) => (lane, None),
            Destination::Device(layout) => (0, Some(layout)),
        };
        let mut rec = Recorder::new(arena.device().limits());
        let cameras = rec.input::<CameraRows>("cameras", key.shape.cameras);
        let inputs = FrameInputs { scene: scene.tensors(), cameras, shape: key.shape, options: &options, capacity };
        let outputs = inputs.record_in(&mut rec, layout);
        let run = Run::in_arena(arena, lane, rec.finish()?, [scene.resident().clone()])?.in_flight()?;
        Ok(Self { key, scene: *scene.tensors(), run, cameras, outputs })
    }

    /// Reads the pictures of a plan for the host.
    pub fn read(&self) -> Result<Vec<RenderOutput>> {
        let (options, Destination::Host(_)) = self.key.options else { return Ok(Vec::new()) };
        let values: Vec<f32> = self.run.read(self.outputs.frames)?;
        let FrameShape { cameras, width, height } = self.key.shape;
        let frame = |values| RenderOutput::from_channels(width, height, values, &options);
        if cameras == 1 {
            return Ok(vec![frame(values)]);
        }
        Ok(values.chunks_exact(values.len() / cameras).map(|values| frame(values.to_vec())).collect())
    }
}
