use super::{
    plan::{Job, PartTensors, PlanTensors, job, vectors_at_once},
    rows,
};
use crate::{
    Result,
    gpu::{Limits, Recorder, ResidentLayout},
    stages::{
        FrameShape,
        render::{SceneTensors, VECTOR, first_capacity, used_degree},
    },
    types::{Camera, Scene},
};

/// Device memory of [`FeatureRenderer::lift`](super::FeatureRenderer::lift), in bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LiftMemory {
    /// Gaussians.
    pub scene: u64,
    /// Sums of a part of the channels, and weights.
    pub features: u64,
    /// Scratch of one photo.
    pub arena: u64,
    /// Parts of the channels, each a pass over all photos.
    pub parts: usize,
}

impl LiftMemory {
    /// Plans without a device, for values of `cells` columns and rows per photo. The arena grows
    /// beyond four tile intersections per Gaussian in a photo.
    ///
    /// # Errors
    /// As [`FeatureRenderer::lift`](super::FeatureRenderer::lift).
    pub fn of(
        limits: &Limits,
        scene: &Scene,
        cameras: &[Camera],
        group: usize,
        channels: usize,
        cells: [u32; 2],
    ) -> Result<Self> {
        let (rows, capacity) = (rows(scene, group)?, first_capacity(scene.len()));
        let mut scene_layout = ResidentLayout::new(limits);
        let tensors = SceneTensors::lay_out(&mut scene_layout, scene.len(), used_degree(scene));
        let all = channels.div_ceil(VECTOR);
        let vectors = all.min(vectors_at_once(limits, rows.count + capacity)).max(1);
        let mut layout = ResidentLayout::new(limits);
        let part = PartTensors::lay_out(&mut layout, rows.count, &[vectors]);
        let arena = |camera: &Camera| {
            let shape = FrameShape { cameras: 1, width: camera.intrinsics.width, height: camera.intrinsics.height };
            let mut rec = Recorder::new(limits);
            let job = Job { vectors, cells: Some(cells), ..job(scene, group) };
            PlanTensors::record(&mut rec, &tensors, shape, job, &part, capacity);
            Ok(rec.finish()?.arena_bytes())
        };
        let arenas = cameras.iter().map(arena).collect::<Result<Vec<u64>>>()?;
        Ok(Self {
            scene: scene_layout.bytes(),
            features: layout.bytes(),
            arena: arenas.into_iter().max().unwrap_or_default(),
            parts: all.div_ceil(vectors),
        })
    }

    /// Returns the peak.
    pub fn total(&self) -> u64 {
        self.scene + self.features + self.arena
    }
}
