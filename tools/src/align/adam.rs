//! Adam on poses with an alpha-weighted difference, after ZipSplat's `pose_estimator.py`.

use super::{Aligned, between};
use crate::{capture::draw, metrics::values};
use glam::DVec3;
use zipsplat::{
    Error, Result,
    gpu::{Arena, Recorder, Run, Tensor},
    perceptual::Perceptual,
    refine::{Adam, PoseAdam},
    stages::render::{
        CAMERA_NUMBERS, CameraRows, DeviceScene, FrameInputs, FrameShape, Gradients, RenderOptions, RenderOutputs,
        Renderer, camera_rows,
    },
    types::{Camera, Image},
};

pub(super) const STEPS: usize = 200;
/// Learning rate of rotations in radians and of shifts.
const RATE: f64 = 5e-3;
/// Loss change that ends the search after [`PATIENCE`] smaller ones.
const FLAT: f64 = 1e-5;
const PATIENCE: usize = 5;
const LPIPS: f64 = 0.05;
const EPS: f64 = 1e-8;

/// At most 200 steps, fewer if the mean loss of all photos stays; returns the last poses.
pub fn align(
    renderer: &mut Renderer,
    photos: &[(&Image, &Camera)],
    mut lpips: Option<&mut Perceptual>,
    arena: &Arena,
    reach: &dyn Fn(f64) -> Result<()>,
) -> Result<Vec<Aligned>> {
    let (arena, _claim) = arena.claimed();
    let descent = |(photo, camera): &(&Image, &Camera)| Descent::new(renderer, &arena, &values(photo), camera);
    let mut descents = photos.iter().map(descent).collect::<Result<Vec<_>>>()?;
    let (mut last, mut flat) = (f64::INFINITY, 0);
    for step in 0..STEPS {
        let mut loss = 0.0;
        for (i, descent) in descents.iter_mut().enumerate() {
            reach((step as f64 + i as f64 / photos.len() as f64) / STEPS as f64)?;
            loss += descent.step(renderer, lpips.as_deref_mut())? / photos.len() as f64;
        }
        flat = if (loss - last).abs() < FLAT { flat + 1 } else { 0 };
        last = loss;
        if flat == PATIENCE {
            break;
        }
    }
    let aligned = |((_, camera), Descent { camera: found, .. }): (&(&Image, &Camera), &Descent)| {
        let [turn, shift] = between(camera, found).map(DVec3::length);
        let (before, drawn) = (draw(renderer, camera)?, draw(renderer, found)?);
        Ok(Aligned { camera: *found, drawn, before, turn, shift, doubt: None })
    };
    photos.iter().zip(&descents).map(aligned).collect()
}

pub struct Descent {
    pub camera: Camera,
    adam: PoseAdam,
    /// `[height, width, 3]`.
    truth: Vec<f32>,
    scene: DeviceScene,
    arena: Arena,
    backward: Option<Backward>,
}

impl Descent {
    /// `truth`: photo of the camera's size, `[height][width][rgb]`. Descents of an arena share its
    /// memory.
    pub fn new(renderer: &Renderer, arena: &Arena, truth: &[f32], camera: &Camera) -> Result<Self> {
        let scene =
            renderer.scene().ok_or_else(|| Error::argument("scene to align to", "none", "one that was loaded"))?;
        let (scene, arena) = (scene.clone(), arena.clone());
        let (camera, adam, truth) = (*camera, PoseAdam::default(), truth.to_vec());
        Ok(Self { camera, adam, truth, scene, arena, backward: None })
    }

    /// Returns the loss before the step.
    pub fn step(&mut self, renderer: &mut Renderer, lpips: Option<&mut Perceptual>) -> Result<f64> {
        let (loss, gradient) = self.gradient(renderer, lpips)?;
        self.camera.pose = self.adam.step(Adam::default(), &self.camera.pose, gradient, [RATE; 2]);
        Ok(loss)
    }

    /// Loss and gradient at (w, v) = 0, where the pose is pose o (exp(w^), v).
    pub fn gradient(&mut self, renderer: &mut Renderer, lpips: Option<&mut Perceptual>) -> Result<(f64, [f64; 6])> {
        let frame = renderer.render(&[self.camera], &with_alpha())?.remove(0);
        let (rgb, alpha) = (frame.rgb.unwrap_or_default(), frame.alpha.unwrap_or_default());
        let (mut loss, mut d_frames) = weighted_difference(&rgb, &alpha, &self.truth);
        if let Some(lpips) = lpips {
            let size = [self.camera.intrinsics.width, self.camera.intrinsics.height];
            loss += look_of_what_is_seen(lpips, [&rgb, &self.truth], &alpha, size, &mut d_frames)?;
        }
        loop {
            let backward = match &mut self.backward {
                Some(backward) => backward,
                none => none.insert(Backward::new(&self.scene, &self.arena, &self.camera, renderer.intersections())?),
            };
            match backward.pose_gradient(&self.camera, &d_frames)? {
                Some(gradient) => return Ok((loss, gradient)),
                None => self.backward = None,
            }
        }
    }
}

fn with_alpha() -> RenderOptions {
    RenderOptions { alpha: true, ..RenderOptions::default() }
}

/// Mean absolute difference, and its gradient `[pixels, 4]` by RGBA.
fn weighted_difference(rgb: &[f32], alpha: &[f32], truth: &[f32]) -> (f64, Vec<f32>) {
    let differences = rgb.iter().zip(truth).map(|(a, b)| f64::from(*a) - f64::from(*b));
    let differences: Vec<f64> = differences.collect();
    let of_pixel = |pixel: &[f64]| pixel.iter().map(|d| d.abs()).sum::<f64>();
    let weighted: f64 = differences.chunks_exact(3).zip(alpha).map(|(pixel, a)| f64::from(*a) * of_pixel(pixel)).sum();
    let weights = 3.0 * alpha.iter().map(|a| f64::from(*a)).sum::<f64>() + EPS;
    let loss = weighted / weights;
    let d_pixel = |(pixel, a): (&[f64], &f32)| {
        let sign = |d: f64| if d == 0.0 { 0.0 } else { d.signum() };
        let [r, g, b] = [0, 1, 2].map(|c| f64::from(*a) * sign(pixel[c]) / weights);
        [r, g, b, (of_pixel(pixel) - 3.0 * loss) / weights].map(|d| d as f32)
    };
    (loss, differences.chunks_exact(3).zip(alpha).flat_map(d_pixel).collect())
}

/// LPIPS of picture and photo `[pixels, 3]`, times alpha. Adds its gradient to `d_frames`.
fn look_of_what_is_seen(
    lpips: &mut Perceptual,
    [rgb, truth]: [&[f32]; 2],
    alpha: &[f32],
    size: [u32; 2],
    d_frames: &mut [f32],
) -> Result<f64> {
    let seen = |picture: &[f32]| picture.iter().enumerate().map(|(i, value)| value * alpha[i / 3]).collect::<Vec<_>>();
    let (a, b) = (seen(rgb), seen(truth));
    let (value, d_a) = lpips.gradient([&a, &b], size)?;
    let (_, d_b) = lpips.gradient([&b, &a], size)?;
    for (i, (d_a, d_b)) in d_a.iter().zip(&d_b).enumerate() {
        d_frames[i / 3 * 4 + i % 3] += LPIPS as f32 * alpha[i / 3] * d_a;
        d_frames[i / 3 * 4 + 3] += LPIPS as f32 * (rgb[i] * d_a + truth[i] * d_b);
    }
    Ok(LPIPS * value)
}

struct Backward {
    run: Run,
    cameras: Tensor,
    d_frames: Tensor,
    d_cameras: Tensor,
    outputs: RenderOutputs,
    capacity: usize,
}

impl Backward {
    fn new(scene: &DeviceScene, arena: &Arena, camera: &Camera, intersections: usize) -> Result<Self> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let (shape, capacity) = (FrameShape { cameras: 1, width, height }, intersections + intersections / 4 + 1024);
        let mut rec = Recorder::new(arena.device().limits());
        let cameras = rec.input::<CameraRows>("cameras", 1);
        let d_frames = rec.input::<f32>("d_frames", with_alpha().channels() * width as usize * height as usize);
        let d_cameras = rec.tensor::<[f32; CAMERA_NUMBERS]>("d_cameras", 1);
        rec.fill(d_cameras, 0);
        let gradients = Gradients { scene: None, cameras: Some(d_cameras) };
        let (tensors, options) = (scene.tensors(), scene.fill_in(&with_alpha()));
        let given = |_: &mut Recorder, _: Tensor| d_frames;
        let inputs = FrameInputs { scene: tensors, cameras, shape, options: &options, capacity };
        let (outputs, _) = inputs.record_with_gradients(&mut rec, given, &gradients);
        rec.output(d_cameras);
        let run = Run::in_arena(arena, 0, rec.finish()?, [scene.resident().clone()])?;
        Ok(Self { run, cameras, d_frames, d_cameras, outputs, capacity })
    }

    /// `None` beyond the capacity.
    fn pose_gradient(&mut self, camera: &Camera, d_frames: &[f32]) -> Result<Option<[f64; 6]>> {
        self.run.write(self.cameras, &[camera_rows(camera)])?;
        self.run.write(self.d_frames, d_frames)?;
        self.run.execute()?;
        if self.outputs.needed(&self.run)? > self.capacity {
            return Ok(None);
        }
        let d_camera: Vec<f32> = self.run.read(self.d_cameras)?;
        Ok(Some(std::array::from_fn(|i| f64::from(d_camera[i]))))
    }
}
