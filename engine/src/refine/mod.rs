//! Refinement: tokens, Gaussians and cameras made to fit the photos.

mod adam;
mod gaussians;
mod schedule;
mod start;
mod tokens;
mod views;

pub use adam::{Adam, Space, record_adam};
pub use start::{join, scene_of_points};
pub use tokens::FrozenHead;

use crate::{
    Error, Result,
    gpu::{Device, Profile},
    reconstruct::SceneTokens,
    stages::loss::Loss,
    types::{Camera, Image, Scene},
};
use gaussians::Gaussians;
use glam::DVec3;
use rayon::prelude::*;
use schedule::Schedule;
use std::{
    ops::ControlFlow,
    time::{Duration, Instant},
};
use views::{Order, View, split};

/// From so many photos on one is held out.
const HOLD_OUT_FROM: usize = 9;
/// How often the held-out photos are looked at, or the loss where there are none.
const LOOKS: usize = 20;
/// How many times its least value a loss may be before the refinement ends.
const GROWN: f32 = 2.0;
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
    /// Photos that are not learnt from: the best step is the one that predicts these best. `None`: 1 of 9 or more.
    pub hold_out: Option<usize>,
    /// What is made less.
    pub loss: Loss,
    /// How far a step moves each value.
    pub rates: Rates,
    /// Factor of the mean opacity in the loss.
    pub opacity_penalty: f32,
    /// Factor of the mean scale in the loss, in shares of the scene's distance.
    pub scale_penalty: f32,
    /// Whether photos are small in the first half.
    pub coarse: bool,
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
            rates: Rates::default(),
            opacity_penalty: 0.0,
            scale_penalty: 0.1,
            coarse: true,
            seed: 0,
            profile: false,
        }
    }
}

/// Adam's rates at first, which fall to a tenth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Of centres, in shares of the scene's distance from the cameras.
    pub means: f32,
    /// Of logarithms of scales.
    pub scales: f32,
    /// Of unit quaternions.
    pub quats: f32,
    /// Of logits of opacities.
    pub opacities: f32,
    /// Of coefficients of spherical harmonics.
    pub sh_coeffs: f32,
    /// Of tokens, where these are refined.
    pub tokens: f32,
}

impl Default for Rates {
    fn default() -> Self {
        Self { means: 5e-3, scales: 0.1, quats: 0.03, opacities: 0.2, sh_coeffs: 0.03, tokens: 2e-2 }
    }
}

/// How far a refinement is.
#[derive(Clone, Copy, Debug)]
pub struct Refining {
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
    /// The Gaussians after [`Refined::best_step`], in the order and world that they were given in.
    pub scene: Scene,
    /// Mean loss of the photos of each step.
    pub losses: Vec<f32>,
    /// Steps after which the scene was kept.
    pub best_step: usize,
    /// Steps, and the PSNR of the held-out photos after them, in dB; empty without such photos.
    pub held_out: Vec<(usize, f64)>,
    /// Time of all steps.
    pub took: Duration,
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
/// `progress` is called after every step and may end the refinement: what was best until then is returned.
///
/// # Errors
/// [`Error::Argument`] where the scene, a photo, a camera or the request cannot be used; [`Error::Memory`] where the device
/// has too little.
pub fn refine_scene(
    device: &Device,
    scene: &Scene,
    photos: &[Image],
    cameras: &[Camera],
    request: &Refine,
    mut progress: impl FnMut(Refining) -> ControlFlow<()>,
) -> Result<Refined> {
    let begin = Instant::now();
    scene.validate()?;
    if scene.is_empty() {
        return Err(Error::argument("scene to refine", "no Gaussians", "at least one"));
    }
    check(photos, cameras, request)?;
    let gaussians = Gaussians::new(device, scene, distance(scene, cameras), request)?;
    Refinement::new(gaussians, scene.clone(), photos, cameras, request)?.finish(&mut progress, begin)
}

/// Refines a scene's tokens so that each of `photos` is what the camera of the same index sees, as [`refine_scene`] does: the head
/// that makes Gaussians of them stays as it is. The scene is that of the tokens at the best step.
///
/// # Errors
/// As [`refine_scene`], and [`Error::Argument`] where the tokens are another head's.
pub fn refine_tokens(
    head: &FrozenHead,
    tokens: &SceneTokens,
    photos: &[Image],
    cameras: &[Camera],
    request: &Refine,
    mut progress: impl FnMut(Refining) -> ControlFlow<()>,
) -> Result<Refined> {
    let begin = Instant::now();
    check(photos, cameras, request)?;
    let (gaussians, scene) = tokens::gaussians(head, tokens, request)?;
    Refinement::new(gaussians, scene, photos, cameras, request)?.finish(&mut progress, begin)
}

/// Holds that photos have cameras, and that enough of them are learnt from.
fn check(photos: &[Image], cameras: &[Camera], request: &Refine) -> Result<()> {
    if photos.is_empty() || photos.len() != cameras.len() {
        let expected = format!("one for each of {} photos, at least one", photos.len());
        return Err(Error::argument("cameras", cameras.len(), expected));
    }
    let held_out = request.held_out_of(photos.len());
    if held_out >= photos.len() {
        let expected = format!("fewer than the {} photos", photos.len());
        return Err(Error::argument("held-out photos", held_out, expected));
    }
    Ok(())
}

impl Refine {
    /// Photos of so many that are held out.
    fn held_out_of(&self, photos: usize) -> usize {
        self.hold_out.unwrap_or(usize::from(photos >= HOLD_OUT_FROM))
    }
}

/// A refinement under way.
struct Refinement<'a> {
    photos: &'a [Image],
    cameras: &'a [Camera],
    request: Refine,
    schedule: Schedule,
    gaussians: Gaussians,
    order: Order,
    /// The photos that are learnt from, and those as they are compared now.
    learnt: Vec<usize>,
    views: Vec<View>,
    /// How many times shorter their sides are than at last.
    shrink: u32,
    tested: Vec<View>,
    losses: Vec<f32>,
    held_out: Vec<(usize, f64)>,
    /// The step after which they were looked at last.
    looked: Option<usize>,
    kept: Kept,
}

/// The best Gaussians so far.
struct Kept {
    step: usize,
    scene: Scene,
    /// The mean loss when they were kept, and the size of photos then.
    loss: f32,
    shrink: u32,
}

impl<'a> Refinement<'a> {
    /// `scene` is what the Gaussians are before the first step.
    fn new(
        gaussians: Gaussians,
        scene: Scene,
        photos: &'a [Image],
        cameras: &'a [Camera],
        request: &Refine,
    ) -> Result<Self> {
        let (learnt, held) = split(photos.len(), request.held_out_of(photos.len()));
        let mut request = request.clone();
        request.views_per_step = request.views_per_step.clamp(1, learnt.len());
        let view = |i: &usize| View::new(*i, &photos[*i], &cameras[*i], request.size, 1);
        let tested = held.par_iter().map(view).collect::<Result<Vec<_>>>()?;
        Ok(Self {
            photos,
            cameras,
            schedule: Schedule { steps: request.steps, rate: 1.0, coarse: request.coarse },
            order: Order::new(learnt.len(), request.seed),
            request,
            gaussians,
            learnt,
            views: Vec::new(),
            shrink: 0,
            tested,
            losses: Vec::new(),
            held_out: Vec::new(),
            looked: None,
            kept: Kept { step: 0, scene, loss: f32::INFINITY, shrink: 0 },
        })
    }

    fn finish(mut self, progress: &mut dyn FnMut(Refining) -> ControlFlow<()>, begin: Instant) -> Result<Refined> {
        let stopped = self.run(progress, begin)?;
        let profile = self.request.profile.then(|| self.profile()).transpose()?;
        let Self { losses, kept, held_out, .. } = self;
        let (scene, best_step, took) = (kept.scene, kept.step, begin.elapsed());
        Ok(Refined { scene, losses, best_step, held_out, took, stopped, profile })
    }

    fn run(
        &mut self,
        progress: &mut dyn FnMut(Refining) -> ControlFlow<()>,
        begin: Instant,
    ) -> Result<Option<Stopped>> {
        let steps = self.request.steps;
        let interval = steps.div_ceil(LOOKS).max(1);
        self.look(0)?;
        for step in 0..steps {
            self.resize(step)?;
            let chosen: Vec<usize> = (0..self.request.views_per_step).map(|_| self.order.next()).collect();
            let views: Vec<&View> = chosen.iter().map(|i| &self.views[*i]).collect();
            let loss = self.gaussians.step(&views, self.schedule.rate(step))?;
            self.losses.push(loss);
            let done = step + 1;
            if !loss.is_finite() {
                return Ok(Some(Stopped::Diverged(format!("the loss of step {done} is {loss}"))));
            }
            if done.is_multiple_of(interval) || done == steps {
                if let Some(why) = self.grown(interval) {
                    return Ok(Some(Stopped::Diverged(why)));
                }
                self.look(done)?;
            }
            let left = begin.elapsed().mul_f64((steps - done) as f64 / done as f64);
            let psnr = self.held_out.last().map(|(_, psnr)| *psnr);
            if progress(Refining { step: done, steps, loss: Some(loss), psnr, left }).is_break() {
                self.look(done)?;
                return Ok(Some(Stopped::Cancelled));
            }
        }
        Ok(None)
    }

    /// Brings the photos to the size of a step.
    fn resize(&mut self, step: usize) -> Result<()> {
        let shortest = |i: &usize| views::size(&self.photos[*i], self.request.size, 1).into_iter().min();
        let shortest = self.learnt.iter().filter_map(shortest).min().unwrap_or(0);
        let shrink = self.schedule.shrink(step, shortest);
        if self.shrink != shrink {
            let view = |i: &usize| View::new(*i, &self.photos[*i], &self.cameras[*i], self.request.size, shrink);
            self.views = self.learnt.par_iter().map(view).collect::<Result<Vec<_>>>()?;
            self.shrink = shrink;
        }
        Ok(())
    }

    /// Keeps the Gaussians where they predict the held-out photos best so far; without such photos, always.
    fn look(&mut self, step: usize) -> Result<()> {
        if self.looked == Some(step) {
            return Ok(());
        }
        self.looked = Some(step);
        if !self.tested.is_empty() {
            let mut sum = 0.0;
            for view in &self.tested {
                sum += psnr(&self.gaussians.draw(view)?, view) / self.tested.len() as f64;
            }
            let best = self.held_out.iter().fold(f64::NEG_INFINITY, |best, (_, psnr)| best.max(*psnr));
            self.held_out.push((step, sum));
            // Also where it is NaN.
            let better = sum > best;
            if !better {
                return Ok(());
            }
        }
        if step > 0 {
            self.kept.scene = self.gaussians.scene()?;
            self.kept.step = step;
        }
        Ok(())
    }

    /// Whether the loss of the last steps is far above the least that it was with photos of this size.
    fn grown(&mut self, interval: usize) -> Option<String> {
        let last = &self.losses[self.losses.len().saturating_sub(interval)..];
        let loss = last.iter().sum::<f32>() / last.len() as f32;
        if self.kept.shrink != self.shrink {
            (self.kept.shrink, self.kept.loss) = (self.shrink, f32::INFINITY);
        }
        if loss > GROWN * self.kept.loss {
            return Some(format!("the loss grew from {:.4} to {loss:.4}", self.kept.loss));
        }
        self.kept.loss = self.kept.loss.min(loss);
        None
    }

    fn profile(&mut self) -> Result<Profile> {
        self.resize(self.request.steps)?;
        let views: Vec<&View> = self.views.iter().take(self.request.views_per_step).collect();
        self.gaussians.profile(&views)
    }
}

/// Peak signal-to-noise ratio of a drawn picture, clamped to 0..1, in dB.
fn psnr(drawn: &[f32], view: &View) -> f64 {
    let square = |(drawn, value): (&f32, f32)| f64::from(drawn.clamp(0.0, 1.0) - value).powi(2);
    let squares: f64 = drawn.iter().zip(view.values()).map(square).sum();
    -10.0 * (squares / drawn.len() as f64).max(1e-10).log10()
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
