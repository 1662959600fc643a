use crate::{
    gpu::{Recorder, Tensor},
    kernels::refine as kernels,
    stages::{CameraPart, FrameShape, PIXELS_PER_RUN, camera_parts, record_camera_sums},
};

pub(super) const COLORS: usize = 3;
/// Numbers of a transform.
pub const EXPOSURE_NUMBERS: usize = 12;

/// Frames with the exposures of their photos.
#[derive(Clone, Copy)]
pub struct Exposed {
    frames: Tensor,
    targets: Tensor,
    transforms: Tensor,
    shape: FrameShape,
    /// `[cameras, height, width, 3]` f32.
    pub exposed: Tensor,
}

impl Exposed {
    /// Records the transforms of `frames` `[cameras, height, width, 3]` by `transforms` `[cameras,
    /// 3, 4]`. Values beyond saturated `targets` become those.
    pub fn record(rec: &mut Recorder, [frames, targets, transforms]: [Tensor; 3], shape: FrameShape) -> Self {
        let exposed = rec.tensor::<f32>("exposed", 3 * shape.pixels() * shape.cameras);
        rec.scope("exposure", |rec| {
            for part in camera_parts(rec, shape, &[COLORS]) {
                let [frames, targets, exposed] = [frames, targets, exposed].map(|tensor| part.of(tensor, COLORS));
                let CameraPart { first, cameras, pixels, .. } = part;
                let count = cameras * pixels;
                rec.dispatch(kernels::Exposure { frames, targets, transforms, exposed, count, pixels, first }, count);
            }
        });
        Self { frames, targets, transforms, shape, exposed }
    }

    /// Records the backward pass: `gradient` by the exposed frames becomes that by the frames.
    /// Returns the gradient by the transforms, `[cameras, 3, 4]`.
    pub fn record_backward(self, rec: &mut Recorder, gradient: Tensor) -> Tensor {
        let Self { frames, targets, transforms, shape, .. } = self;
        let d_transforms = rec.tensor::<[f32; EXPOSURE_NUMBERS]>("d_transforms", shape.cameras);
        rec.scope("exposure", |rec| {
            record_camera_sums(rec, shape, &[COLORS], d_transforms, EXPOSURE_NUMBERS, |rec, part, sums| {
                let CameraPart { first, cameras, pixels, groups } = part;
                let kernel = kernels::ExposureBackward {
                    frames: part.of(frames, COLORS),
                    targets: part.of(targets, COLORS),
                    transforms,
                    gradient: part.of(gradient, COLORS),
                    sums,
                    cameras,
                    pixels,
                    groups,
                    first,
                    run: PIXELS_PER_RUN as u32,
                };
                rec.dispatch_groups(kernel, (cameras * groups) as usize);
            });
        });
        d_transforms
    }
}
