//! Refinement: tokens, Gaussians and cameras made to fit the photos.

mod adam;
mod cameras;
mod gaussians;
mod growth;
mod plan;
mod planned;
mod refinement;
mod schedule;
mod start;
mod tokens;
mod views;

pub use adam::{Adam, Space, record_adam};
pub use cameras::PoseAdam;
pub use plan::{Moved, RefinePlan, plan_refinement};
pub use start::{join, scene_of_points};
pub use tokens::FrozenHead;

use crate::{
    Error, Result,
    gpu::{Arena, Profile},
    reconstruct::SceneTokens,
    stages::{loss::Loss, lpips::LpipsNetwork},
    types::{Camera, Image, Scene},
};
use gaussians::Gaussians;
use glam::DVec3;
use growth::padded;
use refinement::Refinement;
use std::{
    ops::ControlFlow,
    time::{Duration, Instant},
};

/// From so many photos on one is held out, unless cameras are refined.
const HOLD_OUT_FROM: usize = 9;
/// Gaussians by which the distance from the cameras is measured, at most.
const SAMPLE: usize = 4096;

/// How Gaussians are refined.
#[derive(Clone, Debug, PartialEq)]
pub struct Refine {
    /// Steps of the optimiser.
    pub steps: usize,
    /// Photos of a step, at most all that are learnt from.
    pub views_per_step: usize,
    /// Most pixels of a photo along x and y; a larger one is compared at the largest size that fits. `None`: as they are.
    pub size: Option<[u32; 2]>,
    /// Photos that are not learnt from: the best step is the one that predicts these best. `None`: 1 of 9 or more, and none where
    /// cameras are refined, since those of held-out photos stay as wrong as they are.
    pub hold_out: Option<usize>,
    /// The loss that is made less.
    pub loss: Loss,
    /// A share of LPIPS in it, for photos that are large enough; photos of a step are then learnt from one after the other. `None`: no
    /// weights of LPIPS are needed.
    pub look: Option<Look>,
    /// How far a step moves each value.
    pub rates: Rates,
    /// The cameras of the photos that are learnt from are moved, too: all but the first of them, which holds the world.
    pub cameras: bool,
    /// How many Gaussians there may be in the end: those that nobody sees, and those that are missing, are put where others are.
    /// `None`: each stays the one that it was.
    pub grow: Option<usize>,
    /// Factor of the mean opacity in the loss.
    pub opacity_penalty: f32,
    /// Factor of the mean scale in the loss, in shares of the scene's distance.
    pub scale_penalty: f32,
    /// Whether photos are small in the first half.
    pub coarse: bool,
    /// Photos of one size whose gradients are computed at once, at most. `None`: all of a step on a GPU, 1 on a CPU.
    pub together: Option<usize>,
    /// Intersections of Gaussians with tiles of a photo that there is room for at first; it grows with what is drawn. `None`: by the
    /// number of Gaussians.
    pub room: Option<usize>,
    /// Steps after which `progress` is shown the scene, over and over. `None`: never.
    pub show: Option<usize>,
    /// Seed of the photos' order.
    pub seed: u64,
    /// Whether a step is timed by kernel.
    pub profile: bool,
}

impl Default for Refine {
    /// 100 steps of 4 photos, one held out of 9 or more.
    fn default() -> Self {
        Self {
            steps: 100,
            views_per_step: 4,
            size: None,
            hold_out: None,
            loss: Loss::L1Dssim,
            look: None,
            rates: Rates::default(),
            cameras: false,
            grow: None,
            opacity_penalty: 0.0,
            scale_penalty: 0.1,
            coarse: true,
            together: None,
            room: None,
            show: None,
            seed: 0,
            profile: false,
        }
    }
}

/// A share of LPIPS in a loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Look {
    /// Factor of the distance.
    pub weight: f32,
    /// The network that sees the pictures, whose weights [`Perceptual::file`](crate::perceptual::Perceptual::file) finds.
    pub network: LpipsNetwork,
}

/// Adam's rates at first, which fall to a tenth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// The rate of centres, in shares of the scene's distance from the cameras.
    pub means: f32,
    /// The rate of logarithms of scales.
    pub scales: f32,
    /// The rate of unit quaternions.
    pub quats: f32,
    /// The rate of logits of opacities.
    pub opacities: f32,
    /// The rate of coefficients of spherical harmonics.
    pub sh_coeffs: f32,
    /// The rate of tokens, where these are refined.
    pub tokens: f32,
    /// The rate of turns of cameras in radians, where these are refined.
    pub turns: f32,
    /// The rate of their shifts, in shares of the scene's distance from the cameras.
    pub shifts: f32,
}

impl Default for Rates {
    fn default() -> Self {
        Self {
            means: 5e-3,
            scales: 0.1,
            quats: 0.03,
            opacities: 0.2,
            sh_coeffs: 0.03,
            tokens: 2e-2,
            turns: 2e-3,
            shifts: 2e-3,
        }
    }
}

/// How far a refinement is.
#[derive(Clone, Copy, Debug)]
pub struct Refining<'a> {
    /// Steps that are done.
    pub step: usize,
    /// All steps.
    pub steps: usize,
    /// Mean loss of the photos of the last step.
    pub loss: Option<f32>,
    /// PSNR of the held-out photos in dB, when they were looked at last.
    pub psnr: Option<f64>,
    /// Time that is left, as steps took so far.
    pub left: Duration,
    /// The Gaussians after this step, where [`Refine::show`] asks for them.
    pub scene: Option<&'a Scene>,
}

/// Why a refinement ended before its last step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Stopped {
    /// `progress` asked for it.
    Cancelled,
    /// The loss became NaN or infinite, or grew.
    Diverged(String),
}

/// A refined scene.
#[derive(Clone, Debug)]
pub struct Refined {
    /// The Gaussians after [`Refined::best_step`], in the world that they were given in, and in their order unless they grew; where
    /// they did, those that are not drawn are left out.
    pub scene: Scene,
    /// The cameras after that step, of all photos; where they were not refined, as they were given.
    pub cameras: Vec<Camera>,
    /// Mean loss of the photos of each step.
    pub losses: Vec<f32>,
    /// Steps after which the scene was kept.
    pub best_step: usize,
    /// Steps, and the PSNR of the held-out photos after them, in dB; empty without such photos.
    pub held_out: Vec<(usize, f64)>,
    /// Mean PSNR in dB of the training photos at their full size, at most 16 of them, evenly
    /// spread: with the scene that was kept, and before the first step.
    pub training_psnr: [f64; 2],
    /// Photos that were held out.
    pub held: Vec<usize>,
    /// Steps, counted from 0, and the pixels along x and y of the largest photo from each of them on.
    pub sizes: Vec<(usize, [u32; 2])>,
    /// Time of all steps.
    pub took: Duration,
    /// Most bytes that the device had allocated, whatever else is on it included.
    pub peak_bytes: u64,
    /// Why it ended early, where it did.
    pub stopped: Option<Stopped>,
    /// Device time of a step by kernel, where it was asked for.
    pub profile: Option<Profile>,
}

impl Refined {
    /// PSNR of the held-out photos with the scene that was kept, and before the first step.
    pub fn psnr(&self) -> Option<[f64; 2]> {
        let kept = self.held_out.iter().find(|(step, _)| *step == self.best_step)?;
        Some([kept.1, self.held_out.first()?.1])
    }
}

/// Refines a scene's Gaussians so that each of `photos` is what the camera of the same index sees. Cameras are those of the
/// whole photos, in the world of the scene.
///
/// Plans run in `arena`, which may be a model's own, so that no more memory is taken than the largest of all plans needs; where
/// somebody else uses it now, in another one. `progress` is called after every step and may end the refinement: what was best
/// until then is returned.
///
/// # Errors
/// [`Error::Argument`] where the scene, a photo, a camera or the request cannot be used, or the weights of LPIPS that it asks for are
/// missing; [`Error::Memory`] where the device has too little.
pub fn refine_scene(
    arena: &Arena,
    scene: &Scene,
    photos: &[Image],
    cameras: &[Camera],
    request: &Refine,
    progress: impl FnMut(Refining<'_>) -> ControlFlow<()>,
) -> Result<Refined> {
    scene.validate()?;
    if scene.is_empty() {
        return Err(Error::argument("scene to refine", "no Gaussians", "at least one"));
    }
    let unit = distance(scene, cameras);
    let make = |arena: &Arena, request: &Refine| {
        let grown = request.grow.map(|most| padded(scene, most));
        let gaussians = Gaussians::new(arena, grown.as_ref().unwrap_or(scene), unit, request)?;
        Ok((gaussians, (scene.clone(), unit)))
    };
    run(arena, make, photos, cameras, request, progress)
}

/// Refines a scene's tokens so that each of `photos` is what the camera of the same index sees, as [`refine_scene`] does: the head
/// that makes Gaussians of them stays as it is. The scene is that of the tokens at the best step.
///
/// # Errors
/// The errors of [`refine_scene`], and [`Error::Argument`] where the tokens are another head's.
pub fn refine_tokens(
    arena: &Arena,
    head: &FrozenHead,
    tokens: &SceneTokens,
    photos: &[Image],
    cameras: &[Camera],
    request: &Refine,
    progress: impl FnMut(Refining<'_>) -> ControlFlow<()>,
) -> Result<Refined> {
    tokens_grow_not(request)?;
    let make = |arena: &Arena, request: &Refine| {
        let (gaussians, scene) = tokens::gaussians(arena, head, tokens, request)?;
        let unit = distance(&scene, cameras);
        Ok((gaussians, (scene, unit)))
    };
    run(arena, make, photos, cameras, request, progress)
}

/// Refuses to let the Gaussians of tokens grow.
fn tokens_grow_not(request: &Refine) -> Result<()> {
    let refused =
        |most| Error::argument("Gaussians to grow to", most, "none where tokens are refined, which have theirs");
    request.grow.map_or(Ok(()), |most| Err(refused(most)))
}

/// Refines what `make` puts on the device, which is a scene in Gaussians and its distance from the cameras.
fn run(
    arena: &Arena,
    make: impl FnOnce(&Arena, &Refine) -> Result<(Gaussians, (Scene, f64))>,
    photos: &[Image],
    cameras: &[Camera],
    request: &Refine,
    mut progress: impl FnMut(Refining<'_>) -> ControlFlow<()>,
) -> Result<Refined> {
    let begin = Instant::now();
    if photos.is_empty() || photos.len() != cameras.len() {
        let expected = format!("one for each of {} photos, at least one", photos.len());
        return Err(Error::argument("cameras", cameras.len(), expected));
    }
    let request = filled(request, photos.len())?;
    let (arena, _claim) = arena.claimed();
    let (gaussians, scene) = make(&arena, &request)?;
    Refinement::new(gaussians, scene, photos, cameras, request)?.finish(&mut progress, begin)
}

/// The request with what follows from the number of photos filled in.
fn filled(request: &Refine, count: usize) -> Result<Refine> {
    let held_out = request.hold_out.unwrap_or(usize::from(count >= HOLD_OUT_FROM && !request.cameras));
    if held_out >= count {
        return Err(Error::argument("held-out photos", held_out, format!("fewer than the {count} photos")));
    }
    let views_per_step = request.views_per_step.clamp(1, count - held_out);
    Ok(Refine { hold_out: Some(held_out), views_per_step, ..request.clone() })
}

/// Median distance of Gaussians from the cameras that have them in their pictures.
fn distance(scene: &Scene, cameras: &[Camera]) -> f64 {
    let sample = scene.means.iter().step_by(scene.len().div_ceil(SAMPLE));
    let points: Vec<DVec3> = sample.map(|mean| DVec3::from(mean.map(f64::from))).collect();
    let to = |seen: bool| {
        let pairs = cameras.iter().flat_map(|camera| points.iter().map(move |point| (camera, *point)));
        let pairs = pairs.filter(move |(camera, point)| !seen || camera.sees(*point));
        let mut distances: Vec<f64> = pairs.map(|(camera, point)| camera.pose.translation.distance(point)).collect();
        let middle = distances.len() / 2;
        (!distances.is_empty()).then(|| *distances.select_nth_unstable_by(middle, f64::total_cmp).1)
    };
    to(true).or_else(|| to(false)).filter(|distance| *distance > 0.0).unwrap_or(1.0)
}
