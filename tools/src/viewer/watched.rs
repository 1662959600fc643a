use super::{
    live::LiveScene,
    page::ShownScene,
    photos::{FromPhotos, Ready},
};
use crate::{
    known_depth::{KnownDepth, WithDepth},
    options::Antialiasing,
    photos::PhotoFiles,
    process::lock,
    refinement::{Initialization, initial, placed},
    session::Session,
};
use serde::Serialize;
use std::{
    ops::ControlFlow,
    sync::{
        Mutex,
        atomic::{AtomicBool, Ordering},
    },
};
use zipsplat::{
    Result,
    gpu::Arena,
    reconstruct::SceneTokens,
    refine::{FrozenHead, RefineOptions, RefineProgress, RefineResult, StopReason, refine_scene, refine_tokens},
    types::{Camera, Masks, Scene, poses::CaptureView},
};

/// Snapshots of a refinement.
pub(super) const SHOWN: usize = 50;

pub enum Target {
    Scene(Scene),
    Tokens(SceneTokens),
}

pub struct Watched {
    pub(super) target: Target,
    /// Gaussians per token, and the tokens' patches.
    pub(super) tokens: Option<(usize, Vec<u32>)>,
    pub(super) masks: Option<Masks>,
    pub(super) known: Option<KnownDepth>,
    pub(super) cameras: Vec<Camera>,
    pub(super) request: RefineOptions,
    pub(super) now: Mutex<Now>,
    pub stop: AtomicBool,
}

#[derive(Clone, Default, Serialize)]
pub(super) struct Now {
    step: usize,
    steps: usize,
    losses: Vec<f32>,
    /// Steps and held-out PSNR in dB.
    psnr: Vec<(usize, f64)>,
    seconds_left: f64,
    /// Increases with every scene.
    version: usize,
    /// Final message.
    ended: Option<String>,
    #[serde(skip)]
    scene: Option<Scene>,
}

impl FromPhotos {
    pub fn watched(
        &self,
        session: &mut Session<'_>,
        ready: &Ready<'_>,
        antialiasing: Antialiasing,
    ) -> Result<Option<Watched>> {
        let (Some(steps), Some(first)) = (self.refine.steps(), ready.frames.first()) else { return Ok(None) };
        let live = &ready.live;
        let to_scene = first.camera.pose.inverse();
        let camera = |frame: &CaptureView| Camera { pose: to_scene.compose(&frame.camera.pose), ..frame.camera };
        let cameras: Vec<Camera> = ready.frames.iter().map(camera).collect();
        let frames: Vec<&CaptureView> = ready.frames.iter().collect();
        let made = || live.make(self.quality.ratio_of(live.images.len()), live.first_precision(), None);
        let (target, tokens) = if steps.tokens {
            let shown = ShownScene { group: Some(live.checkpoint.architecture().gaussians_per_token), ..made()?.shown };
            (Target::Tokens(live.tokens()?), Some(shown))
        } else {
            let cloud = ready.cloud.clone().map(|cloud| placed(cloud, &to_scene, 1.0));
            let from = Initialization::or_best(self.refine.settings.init, cloud.as_ref(), self.weights.is_builtin());
            let (scene, shown) = if from.needs()[0] {
                made().map(|LiveScene { scene, shown }| (Some(scene), Some(shown)))?
            } else {
                (None, None)
            };
            let photos = PhotoFiles::new(&ready.photos, &frames, self.finding.masks())?;
            (
                Target::Scene(
                    initial(
                        session,
                        from,
                        scene,
                        cloud.as_ref(),
                        &photos,
                        &cameras,
                        self.refine.settings.max_gaussians,
                    )?
                    .0,
                ),
                shown.filter(|_| from == Initialization::Scene),
            )
        };
        let settings = &self.refine.settings;
        let known = settings.known_depth(session, &ready.photos, &frames, &cameras, 1.0)?;
        let request = settings.request(steps, antialiasing, known.as_ref().map(|known| known.kind), &ready.photos);
        let tokens = tokens.filter(|_| request.max_gaussians.is_none());
        let tokens = tokens.and_then(|shown| Some((shown.group?, shown.patches)));
        Ok(Some(Watched {
            target,
            tokens,
            masks: self.finding.masks(),
            known,
            cameras,
            request: RefineOptions { snapshots: SHOWN, ..request },
            now: Mutex::default(),
            stop: AtomicBool::new(false),
        }))
    }
}

impl Watched {
    /// `progress` gets the finished fraction.
    pub fn run(&self, ready: &Ready<'_>, mut progress: impl FnMut(f64) -> ControlFlow<()>) -> Result<()> {
        let report = |at: RefineProgress<'_>| {
            self.tell(&at);
            let share = progress(at.step as f64 / at.steps as f64);
            if self.stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { share }
        };
        let (cameras, request, live) = (&self.cameras, &self.request, &ready.live);
        // The slider uses the model's arena meanwhile.
        let arena = Arena::new(&live.device);
        let frames: Vec<&CaptureView> = ready.frames.iter().collect();
        let refined = PhotoFiles::new(&ready.photos, &frames, self.masks.clone()).and_then(|photos| {
            let photos = WithDepth { photos, depth: self.known.as_ref(), stage: None };
            match &self.target {
                Target::Scene(scene) => refine_scene(&arena, scene, photos, cameras, request, report),
                Target::Tokens(tokens) => FrozenHead::load(&live.device, &live.checkpoint)
                    .and_then(|head| refine_tokens(&arena, &head, tokens, photos, cameras, request, report)),
            }
        });
        self.end(refined)
    }

    pub fn state(&self) -> Vec<u8> {
        serde_json::to_vec(&*lock(&self.now)).expect("plain values")
    }

    pub fn scene(&self) -> Option<LiveScene> {
        let now = lock(&self.now);
        let name = match now.ended {
            Some(_) => "refined".to_owned(),
            None => format!("step {} of {}", now.step, now.steps),
        };
        let (group, patches) = self.tokens.clone().unzip();
        let shown = ShownScene { name, group, patches: patches.unwrap_or_default(), ..ShownScene::default() };
        Some(LiveScene { scene: now.scene.clone()?, shown })
    }

    fn tell(&self, at: &RefineProgress<'_>) {
        let mut now = lock(&self.now);
        (now.step, now.steps) = (at.step, at.steps);
        now.seconds_left = at.eta.as_secs_f64();
        now.losses.push(at.loss);
        if at.psnr != now.psnr.last().map(|(_, psnr)| *psnr) {
            now.psnr.extend(at.psnr.map(|psnr| (at.step, psnr)));
        }
        if let Some(scene) = at.scene {
            now.scene = Some(scene.clone());
            now.version += 1;
        }
    }

    fn end(&self, refined: Result<RefineResult>) -> Result<()> {
        let mut now = lock(&self.now);
        let (ended, result) = match refined {
            Ok(refined) => {
                let kept = format!("kept is step {}", refined.best_step);
                let why = match &refined.stop_reason {
                    None => format!("Refined: {kept} of {}.", refined.losses.len()),
                    Some(StopReason::Cancelled) => format!("Stopped: {kept}, the best so far."),
                    Some(StopReason::Diverged(why) | StopReason::Failed(why)) => {
                        format!("Ended early, {why}: {kept}.")
                    }
                };
                now.psnr = refined.holdout_psnr;
                now.scene = Some(refined.scene);
                now.version += 1;
                (why, Ok(()))
            }
            Err(error) => (error.to_string(), Err(error)),
        };
        now.ended = Some(ended);
        result
    }
}
