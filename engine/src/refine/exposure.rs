//! Exposure of photos: a color transform each, from the scene's colors to the photo's.

use super::{adam::HostAdam, gaussians::ADAM, views::View};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{loss::Value, refine as kernels},
    ops::row_chunks,
    stages::FrameShape,
    types::ColorTransform,
};

/// Numbers of a transform.
pub const EXPOSURE_NUMBERS: usize = 12;
/// Pixels per invocation of the backward pass.
const RUN: usize = 8;
/// Factor of half the squared distance from the identity in a photo's loss.
const PRIOR: f64 = 0.1;
/// Limit of a photo's first brightness relative to the scene's, and of its inverse.
const MAX_GAIN: f64 = 4.0;
/// Part of the squared error that different exposures explain if they are to be learned.
const EXPLAINED: f64 = 0.33;
/// Upper limit of a transform's rate in a step.
const MAX_RATE: f64 = 0.1;

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
    /// 3, 4]`. Values beyond the white or black of saturated `targets` become those.
    pub fn record(rec: &mut Recorder, [frames, targets, transforms]: [Tensor; 3], shape: FrameShape) -> Self {
        let pixels = shape.width as usize * shape.height as usize;
        let exposed = rec.tensor::<[f32; 3]>("exposed", shape.cameras * pixels);
        let all = Self { frames, targets, transforms, shape, exposed };
        rec.scope("exposure", |rec| {
            for part in all.parts(rec, exposed) {
                let (count, pixels) = (part.shape.cameras * pixels, pixels as u32);
                let Self { frames, targets, transforms, exposed, .. } = part;
                let kernel = kernels::Exposure { frames, targets, transforms, exposed, count: count as u32, pixels };
                rec.dispatch(kernel, count);
            }
        });
        all
    }

    /// Records the backward pass: `gradient` by the exposed frames becomes that by the frames.
    /// Returns the gradient by the transforms, `[cameras, 3, 4]`.
    pub fn record_backward(self, rec: &mut Recorder, gradient: Tensor) -> Tensor {
        let d_transforms = rec.tensor::<[f32; EXPOSURE_NUMBERS]>("d_transforms", self.shape.cameras);
        let pixels = self.shape.width as usize * self.shape.height as usize;
        let groups = pixels.div_ceil(RUN * rec.limits().subgroup_size as usize);
        rec.scope("exposure", |rec| {
            let mut first = 0;
            for part in self.parts(rec, gradient) {
                let cameras = part.shape.cameras;
                let sums = rec.tensor::<f32>("sums", EXPOSURE_NUMBERS * cameras * groups);
                let kernel = kernels::ExposureBackward {
                    frames: part.frames,
                    targets: part.targets,
                    transforms: part.transforms,
                    gradient: part.exposed,
                    sums,
                    cameras: cameras as u32,
                    pixels: pixels as u32,
                    groups: groups as u32,
                    run: RUN as u32,
                };
                rec.dispatch_groups(kernel, cameras * groups);
                let kernel = Value { sums, values: d_transforms, first, count: groups as u32, scale: 1.0 };
                rec.dispatch_groups(kernel, EXPOSURE_NUMBERS * cameras);
                first += (EXPOSURE_NUMBERS * cameras) as u32;
            }
        });
        d_transforms
    }

    /// Returns parts whose pictures fit a binding; `exposed` replaces the exposed frames.
    fn parts(self, rec: &Recorder, exposed: Tensor) -> impl Iterator<Item = Self> + use<> {
        let pixels = self.shape.width as usize * self.shape.height as usize;
        row_chunks(rec, self.shape.cameras, &[12 * pixels, 4 * EXPOSURE_NUMBERS]).map(move |part| {
            let of = |t: Tensor, width: usize| t.slice::<f32>(part.start * width, part.len() * width);
            let [frames, targets, exposed] = [self.frames, self.targets, exposed].map(|t| of(t, 3 * pixels));
            let shape = FrameShape { cameras: part.len(), ..self.shape };
            Self { frames, targets, transforms: of(self.transforms, EXPOSURE_NUMBERS), shape, exposed }
        })
    }
}

/// Factors of a drawn picture's red, green and blue that fit its photo best.
pub(super) struct Gains {
    factors: [f64; 3],
    /// Squared errors of the picture, without and with the factors.
    squares: [f64; 2],
}

impl Gains {
    pub fn new(drawn: &[f32], view: &View) -> Self {
        let mut sums = [[0.0; 3]; 3];
        for (i, (drawn, value)) in drawn.iter().zip(view.values()).enumerate() {
            let [drawn, value] = [drawn.clamp(0.0, 1.0), value].map(f64::from);
            let products = [drawn * drawn, drawn * value, value * value];
            sums[i % 3].iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
        }
        let factor = |[dd, dt, _]: [f64; 3]| if dd > 0.0 { (dt / dd).clamp(1.0 / MAX_GAIN, MAX_GAIN) } else { 1.0 };
        let factors = sums.map(factor);
        let squares = |factors: [f64; 3]| {
            let square = |([dd, dt, tt], factor): ([f64; 3], f64)| tt - factor * (2.0 * dt - factor * dd);
            sums.into_iter().zip(factors).map(square).sum()
        };
        Self { factors, squares: [squares([1.0; 3]), squares(factors)] }
    }

    /// Returns whether different factors explain a large part of the pictures' errors.
    pub fn differ(all: &[Self]) -> bool {
        let [without, with] = [0, 1].map(|i| all.iter().map(|gains| gains.squares[i]).sum::<f64>());
        with < (1.0 - EXPLAINED) * without
    }
}

/// Transforms of all photos. Those of training photos are learned, with the identity as their mean:
/// else a common factor would be the scene's or theirs.
#[derive(Clone)]
pub(super) struct Exposures {
    /// Differences from the identity.
    changes: Vec<[f64; EXPOSURE_NUMBERS]>,
    /// Set from a photo's first use on.
    adams: Vec<Option<HostAdam<EXPOSURE_NUMBERS>>>,
    training: Vec<usize>,
    rate: f64,
}

impl Exposures {
    /// `rate` is that of a transform in a step with all training photos.
    pub fn new(count: usize, training: &[usize], views_per_step: usize, rate: f32) -> Self {
        let steps_per_round = training.len() as f64 / views_per_step as f64;
        Self {
            changes: vec![[0.0; EXPOSURE_NUMBERS]; count],
            adams: vec![None; count],
            training: training.to_vec(),
            rate: (f64::from(rate) * steps_per_round).min(MAX_RATE),
        }
    }

    pub fn has(&self, photo: usize) -> bool {
        self.adams[photo].is_some()
    }

    pub fn start(&mut self, photo: usize, gains: &Gains) {
        self.adams[photo] = Some(HostAdam::default());
        (0..3).for_each(|color| self.changes[photo][5 * color] = gains.factors[color] - 1.0);
    }

    pub fn get(&self, photo: usize) -> ColorTransform {
        let mut transform = ColorTransform::IDENTITY;
        let numbers = transform.0.as_flattened_mut().iter_mut();
        numbers.zip(self.changes[photo]).for_each(|(number, change)| *number += change as f32);
        transform
    }

    pub fn step(&mut self, photo: usize, gradient: [f32; EXPOSURE_NUMBERS], rate: f32) {
        let (Some(adam), changes) = (&mut self.adams[photo], &mut self.changes[photo]) else { return };
        let (gradient, rate) =
            (std::array::from_fn(|i| f64::from(gradient[i]) + PRIOR * changes[i]), self.rate * f64::from(rate));
        let moved = adam.step(ADAM, gradient, |_| rate);
        changes.iter_mut().zip(moved).for_each(|(change, moved)| *change += moved);
    }

    /// Moves the mean of all training photos to the identity, once all have been used.
    pub fn center(&mut self) {
        if !self.training.iter().all(|photo| self.has(*photo)) {
            return;
        }
        let count = self.training.len() as f64;
        for i in 0..EXPOSURE_NUMBERS {
            let mean = self.training.iter().map(|photo| self.changes[*photo][i]).sum::<f64>() / count;
            self.training.iter().for_each(|photo| self.changes[*photo][i] -= mean);
        }
    }
}
