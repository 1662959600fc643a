//! Sums over the pixels of each camera.

use super::FrameShape;
use crate::{
    gpu::{Recorder, Tensor},
    kernels::loss::Value,
    ops::row_chunks,
};

/// Pixels per invocation.
pub(crate) const RUN: usize = 8;

/// Consecutive cameras whose pictures fit a binding.
#[derive(Clone, Copy)]
pub(crate) struct CameraPart {
    pub first: u32,
    pub cameras: u32,
    pub pixels: u32,
    /// Sums per camera.
    pub groups: u32,
}

impl CameraPart {
    /// Returns the part's pictures `[cameras, pixels, channels]`.
    pub fn of(self, pictures: Tensor, channels: usize) -> Tensor {
        let width = channels * self.pixels as usize;
        pictures.slice::<f32>(width * self.first as usize, width * self.cameras as usize)
    }
}

/// Returns the parts of pictures of these numbers of channels.
pub(crate) fn camera_parts(
    rec: &Recorder,
    shape: FrameShape,
    channels: &[usize],
) -> impl Iterator<Item = CameraPart> + use<> {
    let pixels = shape.pixels();
    let groups = pixels.div_ceil(RUN * rec.limits().subgroup_size as usize) as u32;
    let widths: Vec<usize> = channels.iter().map(|channels| size_of::<f32>() * channels * pixels).collect();
    row_chunks(rec, shape.cameras, &widths).map(move |cameras| {
        let [first, cameras] = [cameras.start as u32, cameras.len() as u32];
        CameraPart { first, cameras, pixels: pixels as u32, groups }
    })
}

/// Records `totals` `[cameras, width]`. `record` writes sums of a part, `[cameras, width, groups]`.
pub(crate) fn record_camera_sums(
    rec: &mut Recorder,
    shape: FrameShape,
    channels: &[usize],
    (totals, width): (Tensor, usize),
    record: impl Fn(&mut Recorder, CameraPart, Tensor),
) {
    for part in camera_parts(rec, shape, channels) {
        let counts = width * part.cameras as usize;
        let sums = rec.tensor::<f32>("sums", counts * part.groups as usize);
        record(rec, part, sums);
        let kernel = Value { sums, values: totals, first: width as u32 * part.first, count: part.groups, scale: 1.0 };
        rec.dispatch_groups(kernel, counts);
    }
}
