//! Lower limit of scales by the training cameras' resolution.
//!
//! Source: Mip-Splatting (Yu et al. 2024), 3D smoothing filter. Scales are limited directly, so the
//! Gaussians already are the filtered ones that the paper derives from its parameters.

use crate::{
    Result,
    gpu::{Arena, Recorder, Resident, Run, Tensor},
    kernels::refine::{LeastScales, Smooth},
    ops::row_chunks,
    stages::render::{CameraRows, RenderOptions, SceneTensors, camera_rows},
    types::Camera,
};
use std::sync::Arc;

/// Plan that recomputes the limit for moved Gaussians and cameras.
pub(super) struct Smoothing {
    run: Run,
    cameras: Tensor,
    sizes: Tensor,
}

impl Smoothing {
    pub fn new(
        arena: &Arena,
        memory: &Arc<Resident>,
        scene: &SceneTensors,
        least_scales: Tensor,
        drawing: &RenderOptions,
        camera_count: usize,
    ) -> Result<Self> {
        let mut rec = Recorder::new(arena.device().limits());
        let cameras = rec.input::<CameraRows>("cameras", camera_count);
        let sizes = rec.input::<[u32; 2]>("sizes", camera_count);
        record_least_scales(&mut rec, scene.means, [cameras, sizes], least_scales, drawing.near_plane(), scene.len);
        record_smoothing(&mut rec, scene.scales, (std::env::var("ZS_EXP").ok().as_deref() != Some("never")).then_some(scene.opacities), least_scales, scene.len);
        Ok(Self { run: Run::in_arena(arena, 0, rec.finish()?, [memory.clone()])?, cameras, sizes })
    }

    pub fn execute(&mut self, cameras: &[Camera]) -> Result<()> {
        let sizes: Vec<[u32; 2]> = cameras.iter().map(|c| [c.intrinsics.width, c.intrinsics.height]).collect();
        self.run.write(self.cameras, &cameras.iter().map(camera_rows).collect::<Vec<_>>())?;
        self.run.write(self.sizes, &sizes)?;
        self.run.execute().map(drop)
    }
}

/// Records the least scale `[len]` of Gaussians that `cameras` `[cameras, 8, 4]` of `sizes`
/// `[cameras, 2]` resolve.
pub fn record_least_scales(
    rec: &mut Recorder,
    means: Tensor,
    [cameras, sizes]: [Tensor; 2],
    least_scales: Tensor,
    near: f32,
    len: usize,
) {
    let camera_count = (cameras.bytes() / size_of::<CameraRows>() as u64) as u32;
    rec.scope("smoothing", |rec| {
        for part in row_chunks(rec, len, &[size_of::<[f32; 3]>()]) {
            let kernel = LeastScales {
                means: means.slice::<[f32; 3]>(part.start, part.len()),
                cameras,
                sizes,
                least_scales: least_scales.slice::<f32>(part.start, part.len()),
                count: part.len() as u32,
                camera_count,
                near,
            };
            rec.dispatch(kernel, part.len());
        }
    });
}

/// Records the limit of `scales` `[len, 3]`. `opacities` `[len]`, if given, shrink with the density
/// of the widened Gaussians.
pub fn record_smoothing(
    rec: &mut Recorder,
    scales: Tensor,
    opacities: Option<Tensor>,
    least_scales: Tensor,
    len: usize,
) {
    rec.scope("smoothing", |rec| {
        for part in row_chunks(rec, len, &[size_of::<[f32; 3]>()]) {
            let of = |tensor: Tensor| tensor.slice::<f32>(part.start, part.len());
            let scales = scales.slice::<[f32; 3]>(part.start, part.len());
            let kernel = Smooth {
                scales,
                // A placeholder, if unused.
                opacities: opacities.map_or(scales, of),
                least_scales: of(least_scales),
                count: part.len() as u32,
                compensated: opacities.is_some(),
            };
            rec.dispatch(kernel, part.len());
        }
    });
}
