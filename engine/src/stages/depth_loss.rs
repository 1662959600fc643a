use super::{CameraPart, FrameShape, PIXELS_PER_RUN, record_camera_sums};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::loss::{DepthGradient, DepthSums},
};

const TERMS: usize = 5;
/// RGB, alpha and expected depth.
const CHANNELS: usize = 5;
/// Channels of all pictures: frames, colors, depth.
const ALL: [usize; 3] = [CHANNELS, 3, 1];

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
        rec.scope("depth_loss", |rec| {
            record_camera_sums(rec, shape, &ALL, lines, TERMS, |rec, part, sums| {
                let CameraPart { cameras, pixels, groups, .. } = part;
                let (frames, targets, colors) = (part.of(frames, CHANNELS), part.of(targets, 1), part.of(colors, 3));
                let kernel =
                    DepthSums { frames, targets, colors, sums, cameras, pixels, groups, run: PIXELS_PER_RUN as u32 };
                rec.dispatch_groups(kernel, (cameras * groups) as usize);
            });
        });
        Self { frames, targets, shape, lines, colors }
    }

    /// Records the loss `[cameras]`, in inverse units of length, and its gradient by the frames,
    /// times `weight` `[1]`, beside the gradient `d_colors` by the colors.
    pub fn record_backward(self, rec: &mut Recorder, d_colors: Tensor, weight: Tensor, kind: DepthKind) -> [Tensor; 2] {
        let Self { frames, targets, shape, lines, .. } = self;
        let value = rec.tensor::<f32>("depth_loss", shape.cameras);
        let d_frames = rec.tensor::<f32>("d_frames", CHANNELS * shape.pixels() * shape.cameras);
        rec.scope("depth_loss", |rec| {
            record_camera_sums(rec, shape, &ALL, value, 1, |rec, part, sums| {
                let CameraPart { first, cameras, pixels, groups } = part;
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
                    run: PIXELS_PER_RUN as u32,
                    fitted: kind == DepthKind::Relative,
                };
                rec.dispatch_groups(kernel, (cameras * groups) as usize);
            });
        });
        [value, d_frames]
    }
}
