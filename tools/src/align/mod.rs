//! Camera alignment near an initial estimate, by comparing renderings with the photo.

pub mod adam;

use crate::{
    capture::draw,
    metrics::{mean_color, psnr, values},
};
use clap::ValueEnum;
use glam::{DMat3, DQuat, DVec3};
use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
use nalgebra::{DVector, Dyn, OMatrix, U6, Vector6, storage::Owned};
use serde::Serialize;
use std::{cell::RefCell, iter::successors};
use zipsplat::{
    Result,
    gpu::Arena,
    perceptual::Perceptual,
    stages::render::{RenderOptions, RenderOutput, Renderer},
    types::{Camera, Image, Pose, resample::resize_lanczos},
};

/// Limit of rotation in radians: beyond it, blurred pictures match any photo.
pub const MOST_TURN: f64 = std::f64::consts::PI / 12.0;
/// Limit of shift, at a scene distance of about 1.
pub const MOST_SHIFT: f64 = 0.25;
const STOPPED: f64 = 0.9;
/// Required relative gain in squared error at 0.71 of the movement limit.
const PRIOR: f64 = 0.1;
/// Minimum standard deviation of photo values, in 0..1.
const TEXTURE: f64 = 0.02;
/// Threshold of the robust loss, in 0..1, for occlusion.
const LARGE: f64 = 0.01;
const LEAST_SEEN: f64 = 1e-3;
const SMALLEST: u32 = 20;
/// Half the length of central differences, in pixels at distance 1.
const DIFFERENCE: f64 = 0.5;
/// Relative gain or step length that ends a level.
const TOLERANCE: f64 = 1e-4;
/// Iterations per level, of at most 7 renderings.
const PATIENCE: usize = 12;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// See [`align`].
    LevenbergMarquardt,
    /// Method of ZipSplat's authors: at most 200 steps of Adam, with LPIPS if its weights are
    /// available, all photos until their mean loss stays, without a movement limit
    Adam,
}

impl Method {
    /// Aligns all photos' cameras: one by one, or in step by Adam, which alone uses LPIPS and
    /// `arena`. `reach` gets the finished fraction.
    pub fn align(
        self,
        renderer: &mut Renderer,
        photos: &[(&Image, &Camera)],
        lpips: Option<&mut Perceptual>,
        arena: &Arena,
        reach: &dyn Fn(f64) -> Result<()>,
    ) -> Result<Vec<Aligned>> {
        if self == Self::Adam {
            return adam::align(renderer, photos, lpips, arena, reach);
        }
        // The number of renderings depends on the content.
        let fraction = |i: usize| i as f64 / photos.len() as f64;
        let one =
            |(i, (photo, camera)): (usize, &(&Image, &Camera))| align(renderer, photo, camera, &|| reach(fraction(i)));
        photos.iter().enumerate().map(one).collect()
    }
}

pub struct Aligned {
    pub camera: Camera,
    /// Rendering from the camera, `[height][width][rgb]` in 0..1.
    pub drawn: Vec<f32>,
    /// Rendering from the initial camera.
    pub before: Vec<f32>,
    /// Rotation from the initial camera, in radians.
    pub turn: f64,
    /// Distance from the initial camera, in the unit of the poses.
    pub shift: f64,
    pub doubt: Option<Doubt>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Doubt {
    /// Too little texture; the camera is unchanged.
    Flat,
    /// The camera reached its movement limit.
    Bound,
    /// No better match than the mean color of the nearest input photo.
    Color,
}

/// Minimizes the squared error between the rendering of `camera` and `photo`, divided by the mean
/// alpha so that holes do not count. The scene should be at a distance of about
/// 1. Intrinsics stay fixed.
///
/// Levenberg-Marquardt over 6 degrees of freedom with central differences, coarse to fine. At full
/// size the initial camera stays if none is better. `check` runs before each rendering.
pub fn align(
    renderer: &mut Renderer,
    photo: &Image,
    camera: &Camera,
    check: &dyn Fn() -> Result<()>,
) -> Result<Aligned> {
    let truth = values(photo);
    let before = draw(renderer, camera)?;
    let stay = |doubt| Aligned {
        camera: *camera,
        drawn: before.clone(),
        before: before.clone(),
        turn: 0.0,
        shift: 0.0,
        doubt,
    };
    if psnr(&truth, &mean_color(&truth)) > -20.0 * TEXTURE.log10() {
        return Ok(stay(Some(Doubt::Flat)));
    }
    let halves = successors(Some((photo.width, photo.height)), |(width, height)| Some((width / 2, height / 2)));
    let sizes: Vec<_> = halves.enumerate().take_while(|(i, size)| *i == 0 || size.0.min(size.1) >= SMALLEST).collect();
    let mut movement = Vector6::zeros();
    for (_, (width, height)) in sizes.into_iter().rev() {
        let start = Camera { intrinsics: camera.intrinsics.resized(width, height), ..*camera };
        let search = Search::new(renderer, &resize_lanczos(photo, width, height)?, start, check).from(movement)?;
        let solver = LevenbergMarquardt::new().with_ftol(TOLERANCE).with_xtol(TOLERANCE).with_patience(PATIENCE);
        let (found, _) = solver.minimize(search);
        found.failure.into_inner()?;
        movement = found.movement;
    }
    // Coarse levels may have another minimum.
    let search = Search::new(renderer, photo, *camera, check);
    let errors = search.pixels(&[Vector6::zeros(), movement]);
    search.failure.into_inner()?;
    if errors.is_none_or(|errors| errors[1].norm_squared() >= errors[0].norm_squared()) {
        return Ok(stay(None));
    }
    let found = moved(camera, &movement);
    let drawn = draw(renderer, &found)?;
    let [turn, shift] = turn_and_shift(&movement).map(DVec3::length);
    let stopped = turn > STOPPED * MOST_TURN || shift > STOPPED * MOST_SHIFT;
    Ok(Aligned { camera: found, drawn, before, turn, shift, doubt: stopped.then_some(Doubt::Bound) })
}

struct Search<'a> {
    renderer: RefCell<&'a mut Renderer>,
    check: &'a dyn Fn() -> Result<()>,
    failure: RefCell<Result<()>>,
    truth: DVector<f64>,
    start: Camera,
    movement: Vector6<f64>,
    prior: f64,
}

/// Maps six numbers to a rotation (radians) and a shift on the camera's axes, bounded by a ball.
/// Near 0 the slope is [`MOST_TURN`] or [`MOST_SHIFT`].
fn turn_and_shift(movement: &Vector6<f64>) -> [DVec3; 2] {
    [(0, MOST_TURN), (3, MOST_SHIFT)].map(|(i, most)| {
        let free = DVec3::from_slice(&movement.as_slice()[i..i + 3]);
        most * free / (1.0 + free.length_squared()).sqrt()
    })
}

fn between(from: &Camera, to: &Camera) -> [DVec3; 2] {
    let movement = to.pose.relative_to(&from.pose);
    [DQuat::from_mat3(&movement.rotation).to_scaled_axis(), movement.translation]
}

/// Pseudo-Huber residual.
fn robust(difference: f64) -> f64 {
    let root = (2.0 * ((1.0 + (difference / LARGE).powi(2)).sqrt() - 1.0)).sqrt();
    (LARGE * root).copysign(difference)
}

fn moved(camera: &Camera, movement: &Vector6<f64>) -> Camera {
    let [turn, shift] = turn_and_shift(movement);
    let movement = Pose { rotation: DMat3::from_quat(DQuat::from_scaled_axis(turn)), translation: shift };
    Camera { pose: camera.pose.compose(&movement), ..*camera }
}

impl<'a> Search<'a> {
    fn new(renderer: &'a mut Renderer, photo: &Image, start: Camera, check: &'a dyn Fn() -> Result<()>) -> Self {
        Self {
            renderer: RefCell::new(renderer),
            check,
            failure: RefCell::new(Ok(())),
            truth: DVector::from_iterator(photo.rgb.len(), values(photo).into_iter().map(f64::from)),
            start,
            movement: Vector6::zeros(),
            prior: 0.0,
        }
    }

    /// Scales the prior by the initial error: a poor fit justifies no large step.
    fn from(mut self, movement: Vector6<f64>) -> Result<Self> {
        self.movement = movement;
        let error = self.pixels(&[movement]).map(|pixels| pixels[0].norm_squared());
        self.failure.replace(Ok(()))?;
        self.prior = (PRIOR * error.unwrap_or(0.0)).sqrt();
        Ok(self)
    }

    /// Divides residuals by the root of the mean alpha: hiding the scene must not be a gain.
    fn pixels(&self, movements: &[Vector6<f64>]) -> Option<Vec<DVector<f64>>> {
        let cameras: Vec<Camera> = movements.iter().map(|movement| moved(&self.start, movement)).collect();
        let request = RenderOptions { alpha: true, ..RenderOptions::default() };
        let drawn = (self.check)().and_then(|()| self.renderer.borrow_mut().render(&cameras, &request));
        let frames = drawn.map_err(|error| *self.failure.borrow_mut() = Err(error)).ok()?;
        let residuals = |frame: RenderOutput| {
            let (rgb, alpha) = (frame.rgb.unwrap_or_default(), frame.alpha.unwrap_or_default());
            let seen = alpha.iter().map(|alpha| f64::from(*alpha)).sum::<f64>() / alpha.len() as f64;
            let changed =
                |(i, value): (usize, &f64)| f64::from(rgb[i].clamp(0.0, 1.0)) - f64::from(alpha[i / 3]) * value;
            let pixels = self.truth.iter().enumerate().map(changed).map(robust);
            DVector::from_iterator(self.truth.len(), pixels) / seen.max(LEAST_SEEN).sqrt()
        };
        Some(frames.into_iter().map(residuals).collect())
    }
}

impl LeastSquaresProblem<f64, Dyn, U6> for Search<'_> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, U6>;
    type ParameterStorage = Owned<f64, U6>;

    fn set_params(&mut self, movement: &Vector6<f64>) {
        self.movement = *movement;
    }

    fn params(&self) -> Vector6<f64> {
        self.movement
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        let pixels = self.pixels(&[self.movement])?.remove(0);
        let prior = self.movement.iter().map(|value| self.prior * value);
        Some(DVector::from_iterator(self.truth.len() + 6, pixels.iter().copied().chain(prior)))
    }

    fn jacobian(&self) -> Option<OMatrix<f64, Dyn, U6>> {
        let pixel = DIFFERENCE / self.start.intrinsics.fx;
        let half = |i: usize| pixel / if i < 3 { MOST_TURN } else { MOST_SHIFT };
        let step = |i: usize| Vector6::from_fn(|row, _| if row == i { half(i) } else { 0.0 });
        let movements: Vec<_> = (0..6).flat_map(|i| [self.movement + step(i), self.movement - step(i)]).collect();
        let pixels = self.pixels(&movements)?;
        let columns = pixels.chunks_exact(2).enumerate().flat_map(|(i, pair)| {
            let slope = move |(a, b): (&f64, &f64)| (a - b) / (2.0 * half(i));
            let prior = (0..6).map(move |row| if row == i { self.prior } else { 0.0 });
            pair[0].iter().zip(&pair[1]).map(slope).chain(prior)
        });
        Some(OMatrix::<f64, Dyn, U6>::from_iterator(self.truth.len() + 6, columns))
    }
}
