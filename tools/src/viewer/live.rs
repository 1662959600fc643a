//! Scenes of any ratio on demand, from features on the device.

use super::page::{Ratios, ShownScene};
use crate::{options::Quality, process::lock};
use std::{
    ops::ControlFlow,
    sync::{
        Mutex, MutexGuard, TryLockError,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};
use zipsplat::{
    Error, Result,
    gpu::{Device, Progress},
    ops::{Arithmetic, Precision},
    reconstruct::{BackboneFeatures, Model, Ratio, ReconstructOptions, SceneTokens},
    stages::ViewGrid,
    tune::KernelChoice,
    types::{Image, Pose, SaveOptions, Scene, SceneFormat},
    weights::Checkpoint,
};

const POLL: Duration = Duration::from_millis(5);

pub struct Live<'a> {
    pub device: Device,
    pub(super) checkpoint: Checkpoint,
    pub(super) quality: &'a Quality,
    pub(super) images: Vec<Image>,
    pub(super) request: ReconstructOptions,
    /// Network's world in the scene's, if different.
    pub(super) turned: Option<Pose>,
    pub(super) name: String,
    /// The first precision is initial.
    pub(super) sources: Mutex<Vec<Source>>,
    /// Highest running request, or 0.
    pub(super) latest: AtomicU64,
    pub(super) cancelled: &'a AtomicBool,
}

pub(super) struct Source {
    pub precision: Precision,
    pub model: Model,
    pub features: BackboneFeatures,
}

pub struct LiveScene {
    pub scene: Scene,
    pub shown: ShownScene,
}

impl LiveScene {
    /// A line of JSON, then the scene at full precision.
    pub fn encode(mut self) -> Result<Vec<u8>> {
        let begin = Instant::now();
        let ply = self.scene.encode(SceneFormat::Ply, &SaveOptions::default(), None)?;
        self.shown.bytes = ply.len() as u64;
        self.shown.times.push(("pack".into(), milliseconds(begin.elapsed())));
        let mut bytes = serde_json::to_vec(&self.shown).expect("plain values");
        bytes.push(b'\n');
        bytes.extend(ply);
        Ok(bytes)
    }
}

impl Live<'_> {
    /// Stops if a higher `number` overtakes it: requests may arrive out of order. The default is
    /// the next number.
    pub fn make(&self, ratio: f64, precision: Precision, number: Option<u64>) -> Result<LiveScene> {
        let own = number.unwrap_or_else(|| self.latest.load(Ordering::SeqCst).saturating_add(1));
        self.latest.fetch_max(own, Ordering::SeqCst);
        let made = self.make_unless(ratio, precision, || self.latest.load(Ordering::SeqCst) > own);
        // A finished request overtakes none.
        let _ = self.latest.compare_exchange(own, 0, Ordering::SeqCst, Ordering::SeqCst);
        made
    }

    /// Acts as [`Live::make`], unless `overtaken`.
    pub fn make_unless(&self, ratio: f64, precision: Precision, overtaken: impl Fn() -> bool) -> Result<LiveScene> {
        let overtaken = || overtaken() || self.cancelled.load(Ordering::Relaxed);
        let go_on = |_: Progress<'_>| if overtaken() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
        let mut sources = self.lock(&overtaken)?;
        let mut times = Vec::new();
        let at = match sources.iter().position(|source| source.precision == precision) {
            Some(at) => at,
            None => {
                let begin = Instant::now();
                let arithmetic = KernelChoice::of(&self.device, Some(precision))?.arithmetic;
                let stop = |_: f64| if overtaken() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
                let model = Model::from_checkpoint_with(&self.device, &self.checkpoint, arithmetic, stop)?;
                times.push(("weights".to_owned(), begin.elapsed()));
                let features = model.features(&self.images, &self.request, go_on)?;
                times.extend(features.times.0.clone());
                sources.push(Source { precision, model, features });
                sources.len() - 1
            }
        };
        let Source { model, features, .. } = &sources[at];
        let request = ReconstructOptions { ratio: Ratio::Fixed(ratio), ..self.request.clone() };
        let made = model.reconstruct_features(features, &request, go_on)?;
        times.extend(made.times.0.clone());
        let begin = Instant::now();
        let mut scene = made.to_scene()?;
        drop(sources);
        self.quality.prune(&mut scene, self.checkpoint.architecture());
        self.turned.iter().for_each(|first| scene.place(1.0, first));
        times.push(("read".into(), begin.elapsed()));
        let all = self.checkpoint.architecture().gaussians_per_token;
        let shown = ShownScene {
            name: self.name.clone(),
            group: self.quality.kept().map(|keep| keep as usize).or(Some(all)),
            patches: made.patches.indices(),
            times: times.into_iter().map(|(stage, took)| (stage, milliseconds(took))).collect(),
            skipped_passes: made.skipped_passes,
            ..ShownScene::default()
        };
        Ok(LiveScene { scene, shown })
    }

    /// First precision's, for refinement.
    pub fn tokens(&self) -> Result<SceneTokens> {
        let sources = self.lock(&|| self.cancelled.load(Ordering::Relaxed))?;
        sources[0].model.tokens(&sources[0].features, &self.request, |_| ControlFlow::Continue(()))
    }

    pub fn grid(&self) -> ViewGrid {
        lock(&self.sources)[0].features.grid()
    }

    pub fn go_on(&self) -> ControlFlow<()> {
        if self.cancelled.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    pub fn first_precision(&self) -> Precision {
        lock(&self.sources)[0].precision
    }

    pub fn ratios(&self) -> Ratios {
        let tokens = self.grid().tokens();
        let first = self.first_precision();
        let others = Precision::ALL.into_iter().filter(|other| *other != first);
        let known = others.filter(|other| {
            let arithmetic = Arithmetic::of(*other, self.device.limits());
            arithmetic.is_some_and(|arithmetic| self.checkpoint.suits(arithmetic).is_ok())
        });
        let precisions = std::iter::once(first).chain(known).map(Precision::name).collect();
        Ratios { tokens, ratio: self.quality.ratio_of(self.images.len()), precisions }
    }

    fn lock(&self, overtaken: &dyn Fn() -> bool) -> Result<MutexGuard<'_, Vec<Source>>> {
        loop {
            match self.sources.try_lock() {
                Ok(sources) => return Ok(sources),
                // Sources stay complete across a panic.
                Err(TryLockError::Poisoned(poisoned)) => return Ok(poisoned.into_inner()),
                Err(TryLockError::WouldBlock) if overtaken() => return Err(Error::Cancelled),
                Err(TryLockError::WouldBlock) => std::thread::sleep(POLL),
            }
        }
    }
}

fn milliseconds(time: Duration) -> f64 {
    (1e5 * time.as_secs_f64()).round() / 100.0
}
