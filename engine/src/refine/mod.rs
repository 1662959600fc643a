//! Refinement of tokens, Gaussians and cameras against photos.

mod adam;
mod anisotropy;
mod cameras;
mod checkpoint;
mod depth;
mod dropout;
mod exposed;
mod exposure;
mod free_space;
mod gaussians;
mod growth;
mod length;
mod options;
mod pace;
mod photos;
mod plan;
mod planned;
mod refinement;
mod schedule;
mod stereo;
mod tokens;
mod views;

pub use crate::stages::depth_loss::DepthKind;
pub use adam::{Adam, Rate, Space, record_adam};
pub use anisotropy::record_anisotropy_limit;
pub use cameras::PoseAdam;
pub use checkpoint::RefineCheckpoint;
pub use dropout::record_dropout;
pub use exposed::{EXPOSURE_NUMBERS, Exposed};
pub use options::{DepthLoss, Exposure, LearningRates, PerceptualLoss, RefineLength, RefineOptions};
pub use photos::Photos;
pub use plan::{Moved, RefinePlan, plan_refinement};
pub use stereo::stereo_points;
pub use tokens::FrozenHead;

use crate::{
    Error, Result,
    gpu::{Arena, Profile},
    reconstruct::SceneTokens,
    types::{Camera, ColorTransform, Scene, median},
};
use checkpoint::{hashed, hashed_scene, identity};
use gaussians::Gaussians;
use glam::DVec3;
use growth::padded;
use length::{dropout, grown_len, size_in_time, sizes, steps_in_time};
use pace::{Pace, Work};
use photos::PhotoCache;
use refinement::{Refinement, Saving};
use std::{
    ops::ControlFlow,
    time::{Duration, Instant},
};

/// Fewest photos with a held-out one by default: with fewer, all train.
const HOLD_OUT_FROM: usize = 40;
/// Limit of the training PSNR in dB for growth by default.
const GROWTH_BELOW: f64 = 25.0;
const SAMPLE: usize = 4096;

/// Progress of a refinement.
#[derive(Clone, Copy, Debug)]
pub struct RefineProgress<'a> {
    /// Completed steps.
    pub step: usize,
    /// Total steps.
    pub steps: usize,
    /// Mean loss over the last step's photos.
    pub loss: f32,
    /// Latest PSNR of the held-out photos in dB.
    pub psnr: Option<f64>,
    /// Estimated time left.
    pub eta: Duration,
    /// Gaussians after this step, for [`RefineOptions::snapshots`].
    pub scene: Option<&'a Scene>,
}

/// Reason for an early end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// Requested by `progress`.
    Cancelled,
    /// The loss became NaN or infinite, or grew.
    Diverged(String),
    /// A photo could not be opened, a checkpoint written or a step's memory allocated.
    Failed(String),
}

/// Result of a refinement.
#[derive(Clone, Debug)]
pub struct RefineResult {
    /// Gaussians after [`RefineResult::best_step`], in their original world.
    pub scene: Scene,
    /// Cameras of all photos after that step.
    pub cameras: Vec<Camera>,
    /// Transforms from the kept scene's colors to all photos', if learned; the identity for
    /// held-out photos.
    pub exposures: Option<Vec<ColorTransform>>,
    /// Steps of the continued checkpoint, or 0.
    pub resumed_step: usize,
    /// Steps to complete, also of a [`RefineLength::Time`].
    pub steps: usize,
    /// Mean loss per completed step over its photos.
    pub losses: Vec<f32>,
    /// Steps before the kept scene.
    pub best_step: usize,
    /// Steps and the held-out PSNR in dB after them.
    pub holdout_psnr: Vec<(usize, f64)>,
    /// Mean PSNR in dB of at most 16 training photos: with the kept scene, and before.
    pub training_psnr: [f64; 2],
    /// Fraction of masked pixels in those photos.
    pub masked_fraction: f64,
    /// Fraction of those pixels with known depth, for [`RefineOptions::depth_loss`].
    pub depth_fraction: f64,
    /// Indices of the held-out photos.
    pub holdout_views: Vec<usize>,
    /// Steps with a new size, and the largest photo's width and height from then on.
    pub sizes: Vec<(usize, [u32; 2])>,
    /// Time of all steps.
    pub took: Duration,
    /// Peak bytes allocated on the device.
    pub peak_bytes: u64,
    /// Bytes of photos kept on the host.
    pub photo_bytes: u64,
    /// Reason for an early end.
    pub stop_reason: Option<StopReason>,
    /// Profile of a step by kernel, if requested.
    pub profile: Option<Profile>,
}

impl RefineResult {
    /// Held-out PSNR with the kept scene and before the first step.
    pub fn psnr(&self) -> Option<[f64; 2]> {
        let kept = self.holdout_psnr.iter().find(|(step, _)| *step == self.best_step)?;
        Some([kept.1, self.holdout_psnr.first()?.1])
    }
}

/// Refines a scene's Gaussians against `photos`; from 50 steps on, floaters are cleared. Cameras
/// are of the whole photos, in the scene's world.
///
/// `progress` runs after every step; if it ends the refinement, the best scene so far is returned.
///
/// # Errors
/// [`Error::Argument`] for an unusable scene, photo, camera or options, or missing LPIPS weights.
pub fn refine_scene(
    arena: &Arena,
    scene: &Scene,
    photos: impl Photos,
    cameras: &[Camera],
    options: &RefineOptions,
    progress: impl FnMut(RefineProgress<'_>) -> ControlFlow<()>,
) -> Result<RefineResult> {
    scene.validate()?;
    if scene.is_empty() {
        return Err(Error::argument("scene to refine", "no Gaussians", "at least one"));
    }
    let scene_distance = distance(scene, cameras);
    let make = |arena: &Arena, options: &RefineOptions| {
        let grown = options.max_gaussians.map(|most| padded(scene, most));
        let gaussians = Gaussians::new(arena, grown.as_ref().unwrap_or(scene), scene_distance, options)?;
        Ok((gaussians, scene.clone(), scene_distance))
    };
    let hash = || Ok(hashed_scene(scene));
    run(arena, Initial { make: &make, hash: &hash, len: Some(scene.len()) }, &photos, cameras, options, progress)
}

/// Refines a scene's tokens through the frozen head, as [`refine_scene`].
///
/// # Errors
/// Those of [`refine_scene`], and [`Error::Argument`] if the tokens belong to another head.
pub fn refine_tokens(
    arena: &Arena,
    head: &FrozenHead,
    tokens: &SceneTokens,
    photos: impl Photos,
    cameras: &[Camera],
    options: &RefineOptions,
    progress: impl FnMut(RefineProgress<'_>) -> ControlFlow<()>,
) -> Result<RefineResult> {
    tokens_grow_not(options)?;
    if tokens.count() == 0 {
        return Err(Error::argument("tokens to refine", "none", "at least one, of a patch that no mask hides"));
    }
    let make = |arena: &Arena, options: &RefineOptions| {
        let (gaussians, scene) = tokens::gaussians(arena, head, tokens, options)?;
        let scene_distance = distance(&scene, cameras);
        Ok((gaussians, scene, scene_distance))
    };
    let hash = || Ok(hashed(0, &tokens.resident().read::<f32>(tokens.tensor())?));
    run(arena, Initial { make: &make, hash: &hash, len: None }, &photos, cameras, options, progress)
}

fn tokens_grow_not(options: &RefineOptions) -> Result<()> {
    let refused =
        |most| Error::argument("Gaussians to grow to", most, "none where tokens are refined, which have theirs");
    options.max_gaussians.map_or(Ok(()), |most| Err(refused(most)))
}

/// Creates Gaussians, their scene and its distance.
type Make<'a> = dyn Fn(&Arena, &RefineOptions) -> Result<(Gaussians, Scene, f64)> + 'a;

struct Initial<'a> {
    make: &'a Make<'a>,
    /// Identifies the initial values.
    hash: &'a dyn Fn() -> Result<u64>,
    /// Number of Gaussians, if it can grow.
    len: Option<usize>,
}

fn run(
    arena: &Arena,
    Initial { make, hash, len }: Initial<'_>,
    photos: &dyn Photos,
    cameras: &[Camera],
    options: &RefineOptions,
    mut progress: impl FnMut(RefineProgress<'_>) -> ControlFlow<()>,
) -> Result<RefineResult> {
    let begin = Instant::now();
    let count = photos.count();
    if count == 0 || count != cameras.len() {
        let expected = format!("one for each of {count} photos, at least one");
        return Err(Error::argument("cameras", cameras.len(), expected));
    }
    let mut options = filled(options, count)?;
    let (arena, _claim) = arena.claimed();
    let cache = |options: &RefineOptions| {
        let depth = options.depth_loss.map(|loss| loss.kind);
        PhotoCache::new(photos, options.max_image_size, options.coarse_to_fine, options.max_photo_bytes, depth)
    };
    let refinement = |cameras: &[Camera], options: RefineOptions, steps: usize, cached| {
        let (mut gaussians, scene, scene_distance) = make(&arena, &options)?;
        if len.is_some() {
            gaussians.dropout = dropout(&options, steps as f64, count - options.holdout_views.unwrap_or(0));
        }
        Refinement::new(gaussians, scene, scene_distance, cached, cameras, options, steps)
    };
    let grow = |options: &RefineOptions, steps: usize| {
        len.and_then(|len| grown_len(options, steps, len, sizes(photos, options.max_image_size, 1)))
    };
    if options.profile {
        arena.device().limits().check_timestamps()?;
    }
    let mut saving = match &options.checkpoint {
        Some(checkpoint) => {
            let sizes: Vec<[u32; 2]> = (0..count).map(|i| photos.size(i)).collect();
            let identity = identity(checkpoint, arena.device(), &options, hash()?, cameras, &sizes);
            Some(Saving::new(checkpoint.clone(), identity))
        }
        None => None,
    };
    let bytes = saving.as_ref().map_or(Ok(None), |saving| saving.checkpoint.read())?;
    if let (Some(bytes), Some(saving)) = (bytes, &mut saving) {
        let checkpoint = saving.checkpoint.clone();
        let mut state = checkpoint.open(&bytes, &saving.identity)?;
        let steps = saving.restore(&mut state, &mut options)?;
        let cached = cache(&options);
        return refinement(cameras, options, steps, cached)?.finish(&mut progress, begin, Some(saving), Some(state));
    }
    let mut step = Duration::ZERO;
    if let RefineLength::Time(time) = options.length {
        let time_step = |max_image_size: Option<[u32; 2]>| {
            let timed =
                RefineOptions { max_image_size, max_gaussians: None, holdout_views: Some(0), ..options.clone() };
            // Opens only a step's photos.
            let (cached, cameras) = (cache(&timed), &cameras[..timed.views_per_step]);
            refinement(cameras, timed, 1, cached)?.time_step()
        };
        (options.max_image_size, step) = size_in_time(photos, options.max_image_size, time, time_step)?;
    }
    let mut cached = cache(&options);
    let may_grow = options.max_gaussians.is_none() && grow(&options, options.length.most_steps()).is_some();
    if may_grow {
        let mut probe = refinement(cameras, RefineOptions { max_gaussians: None, ..options.clone() }, 1, cached)?;
        if probe.training_psnr()? >= GROWTH_BELOW {
            options.max_gaussians = Some(0);
        }
        cached = probe.photos;
    }
    let work = |steps: usize| Work {
        coarse: options.coarse_to_fine,
        shortest: sizes(photos, options.max_image_size, 1).flatten().min().unwrap_or(0),
        growth: grow(&options, steps).zip(len).map_or(1.0, |(most, len)| most as f64 / len as f64),
    };
    let (steps, pace) = match options.length {
        RefineLength::Steps(steps) => (steps, None),
        RefineLength::Time(time) => {
            // Opening photos may take long: at least half of the time is for steps.
            let left = time.saturating_sub(begin.elapsed()).max(time / 2);
            let most = left.as_secs_f64() / step.as_secs_f64();
            let steps = steps_in_time(most, |steps| steps as f64 * work(steps).between(0.0, 1.0));
            (steps, Some(Pace::new(left, work(steps))))
        }
    };
    options.max_gaussians = grow(&options, steps);
    saving.iter_mut().for_each(|saving| saving.plan(steps, &options));
    let mut refinement = refinement(cameras, options, steps, cached)?;
    refinement.pace = pace;
    refinement.finish(&mut progress, begin, saving.as_mut(), None)
}

fn filled(options: &RefineOptions, count: usize) -> Result<RefineOptions> {
    let held_out = options.holdout_views.unwrap_or(usize::from(count >= HOLD_OUT_FROM && !options.optimize_cameras));
    if held_out >= count {
        return Err(Error::argument("held-out photos", held_out, format!("fewer than the {count} photos")));
    }
    let views_per_step = options.views_per_step.clamp(1, count - held_out);
    Ok(RefineOptions { holdout_views: Some(held_out), views_per_step, ..options.clone() })
}

fn distance(scene: &Scene, cameras: &[Camera]) -> f64 {
    let sample = scene.means.iter().step_by(scene.len().div_ceil(SAMPLE));
    let points: Vec<DVec3> = sample.map(|mean| DVec3::from(mean.map(f64::from))).collect();
    let to = |seen: bool| {
        let pairs = cameras.iter().flat_map(|camera| points.iter().map(move |point| (camera, *point)));
        let pairs = pairs.filter(move |(camera, point)| !seen || camera.project(*point).is_some());
        median(pairs.map(|(camera, point)| camera.pose.translation.distance(point)))
    };
    to(true).or_else(|| to(false)).filter(|distance| *distance > 0.0).unwrap_or(1.0)
}
