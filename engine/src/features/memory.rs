use super::{
    lifted_cells,
    plan::{Job, PartTensors, PlanTensors, job, vectors_at_once},
    rows,
};
use crate::{
    Error, Result,
    gpu::{Limits, Recorder, ResidentLayout},
    stages::{
        FrameShape,
        render::{SceneTensors, VECTOR, first_capacity, planned_capacity, used_degree},
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
    /// Plans without a device, for `cells` columns and rows per photo. The arena grows beyond four
    /// tile intersections per Gaussian.
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
        let (rows, first_capacity) = (rows(scene, group)?, first_capacity(scene.len()));
        let mut scene_layout = ResidentLayout::new(limits);
        let tensors = SceneTensors::lay_out(&mut scene_layout, scene.len(), used_degree(scene));
        let of = |vectors: usize| {
            let mut layout = ResidentLayout::new(limits);
            let part = PartTensors::lay_out(&mut layout, rows, &[vectors]);
            let arena = |camera: &Camera| {
                let shape = FrameShape::of(camera);
                let mut rec = Recorder::new(limits);
                let job = Job { vectors, cells: Some(lifted_cells(cells, camera)), ..job(scene, group) };
                let capacity = planned_capacity(limits.max_binding_bytes, first_capacity, shape, true);
                PlanTensors::record(&mut rec, &tensors, shape, job, &part, capacity);
                Ok(rec.finish()?.arena_bytes())
            };
            let arenas = cameras.iter().map(arena).collect::<Result<Vec<u64>>>()?;
            let arena = arenas.into_iter().max().unwrap_or_default();
            Ok(Self { scene: scene_layout.bytes(), features: layout.bytes(), arena, parts: 0 })
        };
        let all = channels.div_ceil(VECTOR);
        let mut vectors = all.min(vectors_at_once(limits, rows + first_capacity)).max(1);
        let plan = loop {
            match of(vectors) {
                Err(Error::Memory { .. }) if vectors > 1 => vectors /= 2,
                plan => break plan?,
            }
        };
        Ok(Self { parts: all.div_ceil(vectors), ..plan })
    }

    /// Returns the peak.
    pub fn total(&self) -> u64 {
        self.scene + self.features + self.arena
    }
}
