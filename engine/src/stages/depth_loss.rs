use super::FrameShape;
use crate::{
    gpu::{Recorder, Tensor},
    kernels::loss::{DepthGradient, DepthSums, Value},
    ops::row_chunks,
};

/// Pixels per invocation.
const RUN: usize = 8;
const TERMS: usize = 5;
/// RGB, alpha and expected depth.
const CHANNELS: usize = 5;

/// Unit of known depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthKind {
    /// The scene's.
    Metric,
    /// Unknown scale and shift of inverse depth, fitted to each photo's rendered depth.
    Relative,
}

/// Frames `[cameras, height, width, 5]` with alpha and expected depth, and their known depth.
#[derive(Clone, Copy)]
pub struct DepthFrames {
    frames: Tensor,
    targets: Tensor,
    shape: FrameShape,
    /// `[cameras, 5]`.
    lines: Tensor,
    /// `[cameras, height, width, 3]` f32.
    pub colors: Tensor,
}

impl DepthFrames {
    /// Records the colors of `frames` and the fit of `targets` `[cameras, height, width]`, inverse
    /// depth or 0 if unknown.
    pub fn record(rec: &mut Recorder, [frames, targets]: [Tensor; 2], shape: FrameShape) -> Self {
        let colors = rec.tensor::<f32>("frame_colors", 3 * shape.pixels() * shape.cameras);
        let lines = rec.tensor::<[f32; TERMS]>("depth_lines", shape.cameras);
        let split = Self { frames, targets, shape, lines, colors };
        rec.scope("depth_loss", |rec| {
            split.each_part(rec, TERMS, |rec, part, sums| {
                let Part { cameras, pixels, groups, .. } = part;
                let (frames, targets, colors) = (part.of(frames, CHANNELS), part.of(targets, 1), part.of(colors, 3));
                let kernel = DepthSums { frames, targets, colors, sums, cameras, pixels, groups, run: RUN as u32 };
                rec.dispatch_groups(kernel, (cameras * groups) as usize);
                lines
            });
        });
        split
    }

    /// Records the loss `[cameras]`, in inverse units of length, and its gradient by the frames,
    /// times `weight` `[1]`, beside the gradient `d_colors` by the colors.
    pub fn record_backward(self, rec: &mut Recorder, d_colors: Tensor, weight: Tensor, kind: DepthKind) -> [Tensor; 2] {
        let Self { frames, targets, shape, lines, .. } = self;
        let value = rec.tensor::<f32>("depth_loss", shape.cameras);
        let d_frames = rec.tensor::<f32>("d_frames", CHANNELS * shape.pixels() * shape.cameras);
        rec.scope("depth_loss", |rec| {
            self.each_part(rec, 1, |rec, part, sums| {
                let Part { first, cameras, pixels, groups } = part;
                let kernel = DepthGradient {
                    frames: part.of(frames, CHANNELS),
                    targets: part.of(targets, 1),
                    lines,
                    weight,
                    d_colors: part.of(d_colors, 3),
                    d_frames: part.of(d_frames, CHANNELS),
                    sums,
                    cameras,
                    pixels,
                    groups,
                    first,
                    run: RUN as u32,
                    fitted: kind == DepthKind::Relative,
                };
                rec.dispatch_groups(kernel, (cameras * groups) as usize);
                value
            });
        });
        [value, d_frames]
    }

    /// Records parts of the cameras whose frames fit a binding. `record` writes `[cameras, width,
    /// groups]` sums and returns the tensor of their totals.
    fn each_part(self, rec: &mut Recorder, width: usize, record: impl Fn(&mut Recorder, Part, Tensor) -> Tensor) {
        let pixels = self.shape.pixels();
        let groups = pixels.div_ceil(RUN * rec.limits().subgroup_size as usize);
        let widths = [CHANNELS, 3, 1].map(|channels| size_of::<f32>() * channels * pixels);
        for cameras in row_chunks(rec, self.shape.cameras, &widths) {
            let [first, count] = [cameras.start as u32, cameras.len() as u32];
            let part = Part { first, cameras: count, pixels: pixels as u32, groups: groups as u32 };
            let sums = rec.tensor::<f32>("sums", width * cameras.len() * groups);
            let values = record(rec, part, sums);
            let kernel = Value { sums, values, first: width as u32 * first, count: groups as u32, scale: 1.0 };
            rec.dispatch_groups(kernel, width * cameras.len());
        }
    }
}

#[derive(Clone, Copy)]
struct Part {
    first: u32,
    cameras: u32,
    pixels: u32,
    groups: u32,
}

impl Part {
    fn of(self, tensor: Tensor, channels: usize) -> Tensor {
        let width = channels * self.pixels as usize;
        tensor.slice::<f32>(width * self.first as usize, width * self.cameras as usize)
    }
}
