//! Image losses and gradients.
//!
//! Source: SSIM, Wang et al. 2004, with the settings of Kerbl et al. 2023.

use super::FrameShape;
use crate::{
    gpu::{Recorder, Tensor},
    kernels::loss as kernels,
    ops::row_chunks,
};

/// Pixels per invocation: an 11-tap filter loads (RUN + 10) / RUN values for each.
const RUN: usize = 8;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Loss {
    /// |frame - target|.
    L1,
    /// (frame - target)^2.
    Mse,
    /// 1 - SSIM, 11 x 11 Gaussian window of sigma 1.5, zero-padded.
    Dssim,
    /// 0.8 L1 + 0.2 Dssim.
    L1Dssim,
}

#[derive(Clone, Copy, Debug)]
pub struct LossTensors {
    /// `[cameras]` f32.
    pub value: Tensor,
    /// `[cameras, height, width, channels]` f32.
    pub d_frames: Tensor,
}

impl Loss {
    /// Pointwise loss code and weight; weight of 1 - SSIM.
    fn parts(self) -> (u32, f32, Option<f32>) {
        match self {
            Loss::L1 => (1, 1.0, None),
            Loss::Mse => (2, 1.0, None),
            Loss::Dssim => (0, 0.0, Some(1.0)),
            Loss::L1Dssim => (1, 0.8, Some(0.2)),
        }
    }
}

/// Records losses of `frames` `[cameras, height, width, channels]` against `targets` `[cameras,
/// height, width, 3]`, f32. The gradient is of `scale` times their sum.
///
/// SSIM takes 84 scratch bytes per pixel; an image's 48 per pixel must fit a binding.
pub fn record_loss(
    rec: &mut Recorder,
    loss: Loss,
    frames: Tensor,
    targets: Tensor,
    shape: FrameShape,
    channels: usize,
    scale: f32,
) -> LossTensors {
    let pixels = shape.pixels();
    let value = rec.tensor::<f32>("loss", shape.cameras);
    let d_frames = rec.tensor::<f32>("d_frames", shape.cameras * pixels * channels);
    rec.scope("loss", |rec| {
        let scratch = if loss.parts().2.is_some() { 84 * pixels } else { 0 };
        for part in row_chunks(rec, shape.cameras, &[4 * pixels * channels, 12 * pixels, scratch]) {
            let of = |t: Tensor, width: usize| t.slice::<f32>(part.start * width, part.len() * width);
            let (shape, values) = (FrameShape { cameras: part.len(), ..shape }, pixels * channels);
            let pictures = Pictures { frames: of(frames, values), targets: of(targets, 3 * pixels), shape, channels };
            pictures.record(rec, loss, scale, of(d_frames, values), (value, part.start));
        }
    });
    LossTensors { value, d_frames }
}

/// Records the conversion of `photos`, `[ceil(count / 4)]` u32 of 4 bytes, to targets `[count]` f32
/// from 0 to 1.
pub fn record_targets(rec: &mut Recorder, photos: Tensor, count: usize) -> Tensor {
    let targets = rec.tensor::<f32>("targets", count);
    for part in row_chunks(rec, count.div_ceil(4), &[size_of::<u32>(), size_of::<[f32; 4]>()]) {
        let first = 4 * part.start;
        let count = (count - first).min(4 * part.len());
        let kernel = kernels::Targets {
            photos: photos.slice::<u32>(part.start, part.len()),
            targets: targets.slice::<f32>(first, count),
            count: count as u32,
        };
        rec.dispatch(kernel, part.len());
    }
    targets
}

/// Records `frames` with the masked pixels of `targets`, both `[pixels, 3]`: no difference there. A
/// byte of 0 in `masks`, `[ceil(pixels / 4)]` u32, masks its pixel.
///
/// Without targets, records the backward pass: `frames` are the gradient by the masked frames and
/// become that by the frames.
pub fn record_mask(
    rec: &mut Recorder,
    frames: Tensor,
    targets: Option<Tensor>,
    masks: Tensor,
    pixels: usize,
) -> Tensor {
    let result = targets.map_or(frames, |_| rec.tensor::<f32>("masked", 3 * pixels));
    rec.scope("mask", |rec| {
        for part in row_chunks(rec, pixels.div_ceil(4), &[12 * size_of::<f32>(), size_of::<u32>()]) {
            let first = 4 * part.start;
            let count = 3 * (pixels - first).min(4 * part.len());
            let values = |tensor: Tensor| tensor.slice::<f32>(3 * first, count);
            let masks = masks.slice::<u32>(part.start, part.len());
            let (result, gradient, count) = (values(result), targets.is_none(), count as u32);
            // Placeholders, if unused.
            let [frames, targets] = targets.map_or([masks; 2], |targets| [frames, targets].map(values));
            rec.dispatch(kernels::Mask { frames, targets, masks, result, count, gradient }, count);
        }
    });
    result
}

struct Pictures {
    frames: Tensor,
    targets: Tensor,
    shape: FrameShape,
    channels: usize,
}

impl Pictures {
    fn record(&self, rec: &mut Recorder, loss: Loss, scale: f32, d_frames: Tensor, value: (Tensor, usize)) {
        let FrameShape { cameras, width, height } = self.shape;
        let lanes = rec.limits().subgroup_size;
        let groups = [(3 * width).div_ceil(lanes), height.div_ceil(RUN as u32), cameras as u32];
        let group_count = (groups[0] * groups[1]) as usize;
        let sums = rec.tensor::<f32>("sums", cameras * group_count);
        let (pointwise, weight, dssim) = loss.parts();
        let partials = dssim.map(|weight| self.dssim(rec, weight, groups, sums));
        let mean = 1.0 / (3.0 * width as f32 * height as f32);
        let kernel = kernels::Gradient {
            frames: self.frames,
            targets: self.targets,
            partials: partials.unwrap_or(self.frames),
            sums,
            d_frames,
            size: [width, height],
            channels: self.channels as u32,
            weight,
            scale: scale * mean,
            run: RUN as u32,
            pointwise,
            dssim: dssim.is_some(),
        };
        rec.dispatch_groups(kernel, groups);
        let (values, first) = (value.0, value.1 as u32);
        let kernel = kernels::Value { sums, values, first, count: group_count as u32, scale: mean };
        rec.dispatch_groups(kernel, cameras);
    }

    fn dssim(&self, rec: &mut Recorder, weight: f32, groups: [u32; 3], sums: Tensor) -> Tensor {
        let FrameShape { cameras, width, height } = self.shape;
        let (rows, columns, run) = (cameras * height as usize, width as usize, RUN as u32);
        let threads = rows * columns.div_ceil(RUN) * 3;
        let moments = rec.tensor::<[f32; 4]>("moments", rows * columns * 3);
        let kernel = kernels::Moments {
            frames: self.frames,
            targets: self.targets,
            moments,
            rows: rows as u32,
            width,
            channels: self.channels as u32,
            run,
        };
        rec.dispatch(kernel, threads);
        let partials = rec.tensor::<[f32; 3]>("partials", rows * columns * 3);
        rec.dispatch_groups(kernels::Dssim { moments, partials, sums, size: [width, height], weight, run }, groups);
        let out = rec.tensor::<[f32; 3]>("spread", rows * columns * 3);
        rec.dispatch(kernels::Spread { partials, out, rows: rows as u32, width, run }, threads);
        out
    }
}
