//! Scenes of any compression ratio, made while somebody looks: the features of the photos stay on the device, and what follows from
//! them is computed again.

use super::page::{Ratios, ShownScene};
use crate::options::Quality;
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
    reconstruct::{Features, Model, Ratio, Request, SceneTokens},
    stages::ViewGrid,
    tune::Chosen,
    types::{Image, Pose, Scene, SceneFormat, WriteOptions, encode_scene},
    weights::Checkpoint,
};

/// The time after which a request that waits for another looks whether it was overtaken.
const POLL: Duration = Duration::from_millis(5);

/// Photos whose features are on the device.
pub struct Live<'a> {
    /// The device that they are on.
    pub device: Device,
    pub(super) checkpoint: Checkpoint,
    pub(super) quality: &'a Quality,
    /// The pictures that the network sees, and what is known of them.
    pub(super) images: Vec<Image>,
    pub(super) request: Request,
    /// The pose of the network's world in that of the scene, where it is another.
    pub(super) turned: Option<Pose>,
    /// Names of the photos.
    pub(super) name: String,
    /// The network's features in each precision that was asked for so far, the first of them the one to begin with.
    pub(super) sources: Mutex<Vec<Source>>,
    /// The highest number of a request under way, or 0.
    pub(super) latest: AtomicU64,
    /// Set when the command should stop.
    pub(super) cancelled: &'a AtomicBool,
}

/// A model and its features of the photos.
pub(super) struct Source {
    pub precision: Precision,
    pub model: Model,
    pub features: Features,
}

/// A scene and what the page is told of it.
pub struct Made {
    pub scene: Scene,
    pub shown: ShownScene,
}

impl Made {
    /// One line of JSON about the scene, then the scene with all its bits.
    ///
    /// # Errors
    /// As [`encode_scene`].
    pub fn encode(mut self) -> Result<Vec<u8>> {
        let begin = Instant::now();
        let ply = encode_scene(&self.scene, SceneFormat::Ply, &WriteOptions::default())?;
        self.shown.bytes = ply.len() as u64;
        self.shown.times.push(("pack".into(), milliseconds(begin.elapsed())));
        let mut bytes = serde_json::to_vec(&self.shown).expect("plain values");
        bytes.push(b'\n');
        bytes.extend(ply);
        Ok(bytes)
    }
}

impl Live<'_> {
    /// The scene of a ratio, unless a later call overtakes this one: one of a higher `number`, which is the next where nobody says,
    /// as requests do not arrive in the order in which they were sent.
    ///
    /// # Errors
    /// As [`Model::reconstruct_features`], and [`Error::Cancelled`] where it was overtaken.
    pub fn make(&self, ratio: f64, precision: Precision, number: Option<u64>) -> Result<Made> {
        let own = number.unwrap_or_else(|| self.latest.load(Ordering::SeqCst).saturating_add(1));
        self.latest.fetch_max(own, Ordering::SeqCst);
        let made = self.make_unless(ratio, precision, || self.latest.load(Ordering::SeqCst) > own);
        // A request that is done overtakes none, however high its number.
        let _ = self.latest.compare_exchange(own, 0, Ordering::SeqCst, Ordering::SeqCst);
        made
    }

    /// The scene of a ratio, unless `overtaken`.
    ///
    /// # Errors
    /// As [`Live::make`].
    pub fn make_unless(&self, ratio: f64, precision: Precision, overtaken: impl Fn() -> bool) -> Result<Made> {
        let overtaken = || overtaken() || self.cancelled.load(Ordering::Relaxed);
        let go_on = |_: Progress<'_>| if overtaken() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
        let mut sources = self.lock(&overtaken)?;
        let mut times = Vec::new();
        let at = match sources.iter().position(|source| source.precision == precision) {
            Some(at) => at,
            None => {
                let begin = Instant::now();
                let arithmetic = Chosen::of(&self.device, Some(precision))?.arithmetic;
                let stop = |_: f64| if overtaken() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
                let model = Model::load_with(&self.device, &self.checkpoint, arithmetic, stop)?;
                times.push(("weights".to_owned(), begin.elapsed()));
                let features = model.features(&self.images, &self.request, go_on)?;
                times.extend(features.times.0.clone());
                sources.push(Source { precision, model, features });
                sources.len() - 1
            }
        };
        let Source { model, features, .. } = &sources[at];
        let request = Request { ratio: Ratio::Fixed(ratio), ..self.request.clone() };
        let made = model.reconstruct_features(features, &request, go_on)?;
        times.extend(made.times.0.clone());
        let begin = Instant::now();
        let mut scene = made.scene()?;
        drop(sources);
        self.quality.prune(&mut scene, self.checkpoint.architecture());
        self.turned.iter().for_each(|first| scene.place(1.0, first));
        times.push(("read".into(), begin.elapsed()));
        let shown = ShownScene {
            name: self.name.clone(),
            group: Some(self.quality.group(self.checkpoint.architecture())),
            patches: made.patches.indices(),
            times: times.into_iter().map(|(stage, took)| (stage, milliseconds(took))).collect(),
            left_out: made.left_out,
            ..ShownScene::default()
        };
        Ok(Made { scene, shown })
    }

    /// The tokens of the first precision's features, to be refined.
    ///
    /// # Errors
    /// As [`Model::tokens`].
    pub fn tokens(&self) -> Result<SceneTokens> {
        let sources = self.lock(&|| self.cancelled.load(Ordering::Relaxed))?;
        sources[0].model.tokens(&sources[0].features, &self.request, |_| ControlFlow::Continue(()))
    }

    /// The views and their patches.
    pub fn grid(&self) -> ViewGrid {
        self.sources.lock().unwrap_or_else(|poisoned| poisoned.into_inner())[0].features.grid()
    }

    /// Whether what runs should go on.
    pub fn go_on(&self) -> ControlFlow<()> {
        if self.cancelled.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    /// The precision to begin with.
    pub fn first_precision(&self) -> Precision {
        self.sources.lock().unwrap_or_else(|poisoned| poisoned.into_inner())[0].precision
    }

    /// The choices that a page has.
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

    /// The sources, once nobody else uses them.
    fn lock(&self, overtaken: &dyn Fn() -> bool) -> Result<MutexGuard<'_, Vec<Source>>> {
        loop {
            match self.sources.try_lock() {
                Ok(sources) => return Ok(sources),
                // A panic leaves no source half made.
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
