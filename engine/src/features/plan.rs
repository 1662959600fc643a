use crate::{
    Result,
    gpu::{Arena, Device, Limits, Recorder, Resident, ResidentLayout, Run, Tensor},
    stages::{
        FrameShape,
        render::{CameraRows, DeviceScene, FrameInputs, Lifting, RenderOptions, SceneTensors, VECTOR},
    },
    types::Scene,
};
use std::sync::Arc;

/// Device bytes of values beside the scene; more channels take several parts.
const PART_BYTES: usize = 256 << 20;

#[derive(Clone, Copy, PartialEq)]
pub(super) struct Job {
    pub group: usize,
    pub antialiased: bool,
    pub near: f32,
    /// Vectors of a part, and the cells to lift from; pictures have none.
    pub vectors: usize,
    pub cells: Option<[u32; 2]>,
}

pub(super) struct FeaturePlan {
    pub run: Run,
    pub tensors: PlanTensors,
}

pub(super) struct PlanTensors {
    pub camera: Tensor,
    pub values: Option<Tensor>,
    pub pictures: Vec<Tensor>,
    pub status: Tensor,
}

pub(super) struct Part {
    pub resident: Arc<Resident>,
    pub tensors: PartTensors,
}

pub(super) struct PartTensors {
    /// One, or one per pass of drawing.
    pub features: Vec<Tensor>,
    pub totals: Tensor,
}

impl FeaturePlan {
    pub fn new(
        arena: &Arena,
        scene: &DeviceScene,
        shape: FrameShape,
        job: Job,
        part: &Part,
        capacity: usize,
    ) -> Result<Self> {
        let mut rec = Recorder::new(arena.device().limits());
        let tensors = PlanTensors::record(&mut rec, scene.tensors(), shape, job, &part.tensors, capacity);
        let run = Run::in_arena(arena, 0, rec.finish()?, [scene.resident().clone(), part.resident.clone()])?;
        Ok(Self { run, tensors })
    }
}

impl PlanTensors {
    pub fn record(
        rec: &mut Recorder,
        scene: &SceneTensors,
        shape: FrameShape,
        job: Job,
        part: &PartTensors,
        capacity: usize,
    ) -> Self {
        let camera = rec.input::<CameraRows>("cameras", 1);
        let options = RenderOptions {
            rgb: false,
            near: Some(job.near),
            antialiased: Some(job.antialiased),
            ..RenderOptions::default()
        };
        let frame = FrameInputs { scene, cameras: camera, shape, options: &options, capacity };
        let Some(cells) = job.cells else {
            let (pictures, status) = frame.record_pictures(rec, &part.features, job.group);
            return Self { camera, values: None, pictures, status };
        };
        let count = cells[0] as usize * cells[1] as usize * job.vectors;
        let values = rec.input::<[f32; VECTOR]>("values", count);
        let Job { vectors, group, .. } = job;
        let lifting = Lifting { values, cells, vectors, group, lifted: part.features[0], totals: part.totals };
        let status = frame.record_lift(rec, lifting);
        Self { camera, values: Some(values), pictures: Vec::new(), status }
    }
}

impl Part {
    pub fn new(device: &Device, rows: usize, vectors: &[usize]) -> Result<Self> {
        let mut layout = ResidentLayout::new(device.limits());
        let tensors = PartTensors::lay_out(&mut layout, rows, vectors);
        let part = Self { resident: Arc::new(Resident::new(device, &layout)?), tensors };
        let mut rec = Recorder::new(device.limits());
        part.tensors.features.iter().chain([&part.tensors.totals]).for_each(|tensor| rec.fill(*tensor, 0));
        Run::with_resident(device, rec.finish()?, [part.resident.clone()])?.execute()?;
        Ok(part)
    }
}

impl PartTensors {
    pub fn lay_out(layout: &mut ResidentLayout, rows: usize, vectors: &[usize]) -> Self {
        let features = vectors.iter().map(|vectors| layout.add::<[f32; VECTOR]>(rows * vectors)).collect();
        Self { features, totals: layout.add::<f32>(rows) }
    }
}

pub(super) fn vectors_at_once(limits: &Limits, rows: usize) -> usize {
    let bytes = PART_BYTES.min(limits.max_binding_bytes as usize);
    (bytes / (size_of::<[f32; VECTOR]>() * rows.max(1))).max(1)
}

pub(super) fn job(scene: &Scene, group: usize) -> Job {
    Job { group, antialiased: scene.antialiased, near: scene.near(), vectors: 0, cells: None }
}
