//! Features: values of any number of channels, held by Gaussians or by tokens.
//!
//! [`FeatureRenderer::lift`] averages pixel values over photos, weighted by each Gaussian's
//! blending weights.

mod memory;
mod plan;
mod selection;

pub use memory::LiftMemory;

use crate::{
    Error, Result,
    gpu::{Arena, Device, Run, Tensor},
    stages::{
        FrameShape, ViewGrid,
        render::{
            DeviceScene, PlanCache, PlanKey, Renderer, VECTOR, VECTORS_AT_ONCE, camera_rows, check_camera,
            first_capacity, needed,
        },
    },
    types::{Camera, Scene},
};
use plan::{FeaturePlan, Job, Part, job, vectors_at_once};
use std::{iter::zip, ops::Range};

const CHANNELS_AT_ONCE: usize = VECTOR * VECTORS_AT_ONCE;

/// Values of pixels or larger cells, `[height, width, channels]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PixelValues {
    /// Cells per row.
    pub width: u32,
    /// Rows of cells.
    pub height: u32,
    /// Values per cell.
    pub channels: usize,
    /// All values.
    pub values: Vec<f32>,
}

impl PixelValues {
    /// Splits `[views, rows, columns, channels]`, a cell per patch.
    pub(crate) fn of_patches(grid: ViewGrid, channels: usize, values: &[f32]) -> Vec<Self> {
        let (width, height) = (grid.columns as u32, grid.rows as u32);
        let view = |values: &[f32]| Self { width, height, channels, values: values.to_vec() };
        values.chunks_exact(grid.patches() * channels).map(view).collect()
    }
}

/// Values of Gaussians or tokens, `[rows, channels]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// All values.
    pub values: Vec<f32>,
    /// Values per row.
    pub channels: usize,
    /// Consecutive Gaussians of a row: 1, or those of a token.
    pub group: usize,
}

/// Features with their evidence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lifted {
    /// Means over all photos' pixels; 0 for unseen rows.
    pub features: Features,
    /// Sum of each row's blending weights, in pixels.
    pub weights: Vec<f32>,
}

impl Features {
    /// Checks the shape for a scene.
    ///
    /// # Errors
    /// [`Error::Argument`] for another number of rows.
    pub fn validate(&self, scene: &Scene) -> Result<()> {
        let rows = rows(scene, self.group)?;
        let expected = rows * self.channels;
        if self.channels == 0 || self.values.len() != expected {
            let found = format!("{} values of {} channels", self.values.len(), self.channels);
            let expected = format!("at least one channel for each of {rows} rows of {} Gaussians", self.group);
            return Err(Error::argument("features", found, expected));
        }
        Ok(())
    }
}

/// Lifts and draws features on one device.
pub struct FeatureRenderer {
    arena: Arena,
    renderer: Renderer,
    plans: PlanCache<Job, FeaturePlan>,
}

impl FeatureRenderer {
    /// Creates its own arena.
    pub fn new(device: &Device) -> Self {
        let arena = Arena::new(device);
        Self { renderer: Renderer::in_arena(&arena), arena, plans: PlanCache::new(device.limits(), 0) }
    }

    /// Lifts pixel values of `cameras`' pictures to every `group` consecutive Gaussians of a scene.
    /// `values`, called once per part of the channels, returns a camera's, of any size with the
    /// picture's shape. Pixels with a NaN do not count. The same inputs give the same bits.
    ///
    /// # Errors
    /// [`Error::Argument`] for invalid input, those of `values`, and [`Error::Memory`].
    pub fn lift(
        &mut self,
        scene: &Scene,
        cameras: &[Camera],
        group: usize,
        channels: usize,
        mut values: impl FnMut(usize) -> Result<PixelValues>,
    ) -> Result<Lifted> {
        let rows = rows(scene, group)?;
        let features = Features { values: vec![0.0; rows * channels], channels, group };
        let mut lifted = Lifted { features, weights: vec![0.0; rows] };
        lifted.features.validate(scene)?;
        check(cameras)?;
        if scene.is_empty() || cameras.is_empty() {
            return Ok(lifted);
        }
        let device_scene = self.load(scene)?;
        let _claim = self.arena.claim().expect("nobody else knows it");
        let mut vectors = channels.div_ceil(VECTOR).min(self.vectors_at_once(rows + self.plans.capacity));
        let mut first = 0;
        while first < channels {
            let part = first..channels.min(first + VECTOR * vectors);
            first = part.end;
            match self.lift_part(&device_scene, scene, cameras, part.clone(), &mut values, &mut lifted) {
                // Intersections exceeded the first capacity.
                Err(Error::Memory { .. }) if vectors > 1 => (vectors, first) = (vectors / 2, part.start),
                done => done?,
            }
        }
        Ok(lifted)
    }

    fn lift_part(
        &mut self,
        device_scene: &DeviceScene,
        scene: &Scene,
        cameras: &[Camera],
        columns: Range<usize>,
        values: &mut impl FnMut(usize) -> Result<PixelValues>,
        lifted: &mut Lifted,
    ) -> Result<()> {
        let Features { channels, group, .. } = lifted.features;
        let vectors = columns.len().div_ceil(VECTOR);
        let part = self.part(lifted.weights.len(), &[vectors])?;
        for (i, camera) in cameras.iter().enumerate() {
            let values = values(i)?;
            check_values(&values, i, channels)?;
            let values = at_pixels(values, camera);
            let cells = [values.width, values.height];
            let padded = padded(&values.values, channels, columns.clone(), VECTOR * vectors, is_counted);
            let job = Job { vectors, cells: Some(cells), ..job(scene, group) };
            self.run(device_scene, camera, job, &part, Some(&padded), |_, _| Ok(()))?;
        }
        let sums: Vec<f32> = part.resident.read(part.tensors.features[0])?;
        lifted.weights = part.resident.read(part.tensors.totals)?;
        let rows = zip(sums.chunks_exact(VECTOR * vectors), &lifted.weights);
        for ((sums, weight), row) in zip(rows, lifted.features.values.chunks_exact_mut(channels)) {
            let mean = |sum: f32| if *weight > 0.0 { sum / weight } else { 0.0 };
            zip(&mut row[columns.clone()], sums).for_each(|(to, sum)| *to = mean(*sum));
        }
        Ok(())
    }

    fn vectors_at_once(&self, rows: usize) -> usize {
        vectors_at_once(self.arena.device().limits(), rows)
    }

    /// Draws features as pictures of the same channels, 0 where nothing is.
    ///
    /// # Errors
    /// [`Error::Argument`] for invalid input, and [`Error::Memory`].
    pub fn draw(&mut self, scene: &Scene, features: &Features, cameras: &[Camera]) -> Result<Vec<PixelValues>> {
        features.validate(scene)?;
        check(cameras)?;
        let (channels, group) = (features.channels, features.group);
        let rows = rows(scene, group)?;
        let picture = |camera: &Camera| {
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let values = vec![0.0; width as usize * height as usize * channels];
            PixelValues { width, height, channels, values }
        };
        let mut pictures: Vec<PixelValues> = cameras.iter().map(picture).collect();
        if scene.is_empty() {
            return Ok(pictures);
        }
        let device_scene = self.load(scene)?;
        let _claim = self.arena.claim().expect("nobody else knows it");
        let pixels = pictures.iter().map(|picture| picture.values.len() / channels).max().unwrap_or(0);
        let passes = (self.vectors_at_once(rows + pixels) / VECTORS_AT_ONCE).max(1);
        for first in (0..channels).step_by(CHANNELS_AT_ONCE * passes) {
            let passes = passes.min((channels - first).div_ceil(CHANNELS_AT_ONCE));
            let part = self.part(rows, &vec![VECTORS_AT_ONCE; passes])?;
            let range = |pass: usize| {
                let first = first + pass * CHANNELS_AT_ONCE;
                first..(first + CHANNELS_AT_ONCE).min(channels)
            };
            for (pass, tensor) in part.tensors.features.iter().enumerate() {
                let values = padded(&features.values, channels, range(pass), CHANNELS_AT_ONCE, |_| true);
                part.resident.write(*tensor, &values)?;
            }
            for (camera, picture) in zip(cameras, &mut pictures) {
                let job = Job { vectors: VECTORS_AT_ONCE * passes, cells: None, ..job(scene, group) };
                self.run(&device_scene, camera, job, &part, None, |run, drawn| {
                    for (pass, tensor) in drawn.iter().enumerate() {
                        let values: Vec<f32> = run.read(*tensor)?;
                        let pixels =
                            zip(values.chunks_exact(CHANNELS_AT_ONCE), picture.values.chunks_exact_mut(channels));
                        pixels.for_each(|(from, to)| to[range(pass)].copy_from_slice(&from[..range(pass).len()]));
                    }
                    Ok(())
                })?;
            }
        }
        Ok(pictures)
    }

    /// Returns zeroed memory; plans belong to one.
    fn part(&mut self, rows: usize, vectors: &[usize]) -> Result<Part> {
        self.plans.clear();
        Part::new(self.arena.device(), rows, vectors)
    }

    fn load(&mut self, scene: &Scene) -> Result<DeviceScene> {
        self.plans = PlanCache::new(self.arena.device().limits(), first_capacity(scene.len()));
        self.renderer.set_scene(scene)?;
        Ok(self.renderer.scene().expect("just set").clone())
    }

    /// Runs one camera's job until its intersections fit.
    fn run(
        &mut self,
        scene: &DeviceScene,
        camera: &Camera,
        job: Job,
        part: &Part,
        values: Option<&[f32]>,
        read: impl FnOnce(&Run, &[Tensor]) -> Result<()>,
    ) -> Result<()> {
        let shape = FrameShape::of(camera);
        let key = PlanKey { shape, backward: job.cells.is_some(), options: job };
        let record = |capacity| FeaturePlan::new(&self.arena, scene, shape, job, part, capacity);
        let plan = self.plans.run(key, record, |plan| {
            plan.run.write(plan.tensors.camera, &[camera_rows(camera)])?;
            if let Some((tensor, values)) = plan.tensors.values.zip(values) {
                plan.run.write(tensor, values)?;
            }
            plan.run.execute()?;
            needed(&plan.run, plan.tensors.status)
        })?;
        read(&plan.run, &plan.tensors.pictures)
    }
}

fn rows(scene: &Scene, group: usize) -> Result<usize> {
    if group == 0 || !scene.len().is_multiple_of(group) {
        let expected = format!("a divisor of the scene's {} Gaussians", scene.len());
        return Err(Error::argument("Gaussians per feature", group, expected));
    }
    Ok(scene.len() / group)
}

fn check(cameras: &[Camera]) -> Result<()> {
    cameras.iter().enumerate().try_for_each(|(i, camera)| check_camera(i, camera))
}

fn check_values(values: &PixelValues, i: usize, channels: usize) -> Result<()> {
    let PixelValues { width, height, .. } = *values;
    let expected = width as usize * height as usize * channels;
    if expected == 0 || values.channels != channels || values.values.len() != expected {
        let found = format!("{} as {width} x {height} of {} channels", values.values.len(), values.channels);
        return Err(Error::argument(format!("values of picture {i}"), found, format!("{channels} channels per pixel")));
    }
    Ok(())
}

/// Returns the cells to lift from: those given, or fewer pixels.
fn lifted_cells(cells: [u32; 2], camera: &Camera) -> [u32; 2] {
    let pixels = [camera.intrinsics.width, camera.intrinsics.height];
    let count = |[width, height]: [u32; 2]| u64::from(width) * u64::from(height);
    if count(cells) > count(pixels) { pixels } else { cells }
}

/// Returns the values of [`lifted_cells`], chosen as in the kernel.
fn at_pixels(values: PixelValues, camera: &Camera) -> PixelValues {
    let cells = [values.width, values.height];
    let [width, height] = lifted_cells(cells, camera);
    if [width, height] == cells {
        return values;
    }
    let PixelValues { channels, values, .. } = values;
    let cell = |at: u32, cells: u32, pixels: u32| (u64::from(at) * u64::from(cells) / u64::from(pixels)) as usize;
    let pixel = |at: u32| {
        let [x, y] = [cell(at % width, cells[0], width), cell(at / width, cells[1], height)];
        &values[(y * cells[0] as usize + x) * channels..][..channels]
    };
    let values = (0..width * height).flat_map(pixel).copied().collect();
    PixelValues { width, height, channels, values }
}

fn is_counted(row: &[f32]) -> bool {
    !row.iter().any(|value| value.is_nan())
}

/// Returns columns of rows padded with zeros, or NaN if the row fails `is_valid`.
fn padded(
    values: &[f32],
    channels: usize,
    columns: Range<usize>,
    width: usize,
    is_valid: impl Fn(&[f32]) -> bool,
) -> Vec<f32> {
    let mut padded = vec![0.0; values.len() / channels * width];
    for (from, to) in zip(values.chunks_exact(channels), padded.chunks_exact_mut(width)) {
        if is_valid(from) {
            to[..columns.len()].copy_from_slice(&from[columns.clone()]);
        } else {
            to.fill(f32::NAN);
        }
    }
    padded
}
