//! The network's part of `zipsplat reconstruct`: views of the photos to Gaussians.

use super::Reconstruct;
use super::placed::Placed;
use crate::{
    explain::Explanation,
    options::Size,
    session::Session,
    table::{bytes, counted},
    views::Views,
};
use indicatif::HumanCount;
use serde_json::json;
use std::{path::PathBuf, time::Duration};
use zipsplat::{
    Result,
    gpu::Device,
    ops::Precision,
    reconstruct::{Model, Reconstruction, Request, SceneTokens, Shape},
    stages::render::DeviceScene,
    types::{
        Scene,
        poses::{Frame, Poses, Unit},
    },
    weights::Checkpoint,
};

/// The stage whose bytes a second are told.
pub const LOAD_WEIGHTS: &str = "load weights";

/// A forward pass that nothing speaks against.
pub struct Planned<'a> {
    command: &'a Reconstruct,
    checkpoint: &'a Checkpoint,
    photos: &'a [PathBuf],
    poses: Option<&'a Poses>,
    frames: &'a [&'a Frame],
    size: Size,
    shape: Shape,
}

/// The outcome of a forward pass, and how it came about.
pub struct Forward {
    /// The network: what comes next runs in its arena.
    pub model: Model,
    pub result: Reconstruction,
    /// The tokens, where these are to be moved.
    pub tokens: Option<SceneTokens>,
    /// The Gaussians on the host, thinned where that was asked for.
    pub scene: Scene,
    /// The cameras that follow from the scene, where they are asked for.
    pub found: Option<Placed>,
    /// The scene is not as the device has it: its world was turned.
    turned: bool,
    views: usize,
    size: Size,
    all_tokens: usize,
    unit: Option<Unit>,
    precision: Precision,
    provenance: serde_json::Value,
    times: [(&'static str, Duration); 2],
    found_in: Option<Duration>,
    /// Bytes of the weights.
    weights: u64,
}

impl Forward {
    /// Checks what is asked of the network, before a device is opened.
    ///
    /// # Errors
    /// [`zipsplat::Error::Argument`] for what cannot be used.
    pub fn plan<'a>(
        command: &'a Reconstruct,
        session: &mut Session<'_>,
        checkpoint: &'a Checkpoint,
        (photos, poses, frames): (&'a [PathBuf], Option<&'a Poses>, &'a [&'a Frame]),
    ) -> Result<Planned<'a>> {
        let (quality, fit) = (&command.quality, command.fit.fit);
        if command.weights.is_embedded() && poses.is_none() && photos.len() > 1 {
            session.note(
                "the model that is built in is a demonstration: several photos without --poses give colours and coarse shapes; \
                 one photo, or cameras (--poses find finds them), gives more, and the paper's weights (`zipsplat weights get zipsplat`) most",
            );
        }
        if command.weights.is_embedded() && poses.is_none() && command.cameras_out.is_some() {
            session.note(
                "without --poses the model that is built in sees all photos as if from one place: the cameras of --cameras-out fit \
                 its scene, not the photos' place; --poses find finds those",
            );
        }
        let size = quality.size_for(checkpoint);
        fit.check(size, poses.is_some())?;
        session.notes(quality.doubt_size(checkpoint));
        let (views, chosen) = (fit.count(photos)?, (quality.ratio, &quality.select));
        let shape = Shape::new(checkpoint.architecture(), views, [size.0, size.1], chosen, poses.is_some())?;
        Ok(Planned { command, checkpoint, photos, poses, frames, size, shape })
    }

    /// The Gaussians that are on the device as the host has them.
    pub fn on_device(&self) -> Option<&DeviceScene> {
        Some(&self.result.gaussians).filter(|gaussians| !self.turned && gaussians.len() == self.scene.len())
    }

    /// The length in the cameras' unit that the network took for 1.
    pub fn length(&self) -> f64 {
        self.unit.as_ref().map_or(1.0, |unit| unit.length)
    }

    /// Time of each stage.
    pub fn times(&self) -> impl Iterator<Item = (&str, Duration)> {
        let stages = self.result.times.0.iter().map(|(stage, took)| (stage.as_str(), *took));
        self.times.into_iter().chain(stages).chain(self.found_in.map(|took| ("find cameras", took)))
    }

    /// The account of stages for `--explain`.
    pub fn explanation(&self) -> Explanation {
        Explanation::of_stages(&self.result.times, &self.result.outline, self.result.left_out.clone())
    }

    /// The views that the scene comes from, in words.
    pub fn views_told(&self) -> String {
        format!(" from {} of {}", counted(self.views, "view"), self.size)
    }

    /// The tokens in words, and the unit.
    pub fn told(&self) -> String {
        let (tokens, all) = (HumanCount(self.result.tokens as u64), counted(self.all_tokens, "token"));
        let each = counted(self.each(), "Gaussian");
        let unit = self.unit.as_ref().map(|unit| format!("{unit}\n")).unwrap_or_default();
        let cameras = self.found.as_ref().map(Placed::told).unwrap_or_default();
        format!("the network's: {tokens} of {all}, {each} each, {} precision\n{unit}{cameras}", self.precision.name())
    }

    /// How fast the weights were loaded, in words.
    pub fn rate_told(&self) -> String {
        format!("  ({}/s)", bytes(self.rate()))
    }

    /// Adds what it says for programs.
    pub fn add_to(&self, json: &mut serde_json::Value) {
        for (name, value) in [
            ("weights", self.provenance.clone()),
            ("views", json!(self.views)),
            ("width", json!(self.size.0)),
            ("height", json!(self.size.1)),
            ("tokens", json!(self.result.tokens)),
            ("all_tokens", json!(self.all_tokens)),
            ("unit", json!(self.length())),
            ("unit_from", json!(self.unit.as_ref().map(|unit| &unit.source))),
            ("gaussians_per_token", json!(self.each())),
            ("weights_bytes_per_second", json!(self.rate())),
            ("precision", json!(self.precision.name())),
            ("cameras", self.found.as_ref().map_or(json!(null), Placed::as_json)),
        ] {
            json[name] = value;
        }
    }

    fn each(&self) -> usize {
        self.result.gaussians.len() / self.result.tokens
    }

    fn rate(&self) -> u64 {
        let [_, (_, load_weights)] = self.times;
        (self.weights as f64 / load_weights.as_secs_f64().max(1e-9)) as u64
    }
}

impl Planned<'_> {
    /// Runs it.
    ///
    /// # Errors
    /// Those of reading photos and of [`zipsplat::reconstruct::Model::reconstruct`].
    pub fn run(self, session: &mut Session<'_>, device: &Device) -> Result<Forward> {
        let Self { command, checkpoint, photos, poses, frames, size, shape } = self;
        let (quality, fit) = (&command.quality, command.fit.fit);
        let (precision, arithmetic) = quality.arithmetic.choose(session, device)?;
        let (views, load_photos) = session.stage("load photos", |stage| fit.load(photos, frames, size, stage))?;
        let Views { images, cameras, note } = views;
        session.notes(note);
        let unit = match (poses, frames.first()) {
            (Some(poses), Some(first)) => Some(poses.unit(command.unit, &cameras, &first.camera.pose)?),
            _ => None,
        };
        session.notes(unit.as_ref().and_then(Unit::doubt));
        let (cameras, turned) = fit.told(cameras);
        let (model, load_weights) = session.load_model(device, checkpoint, arithmetic)?;
        let cameras = Some(cameras).filter(|cameras| !cameras.is_empty());
        let length = unit.as_ref().map_or(1.0, |unit| unit.length);
        let request = Request { ratio: quality.ratio, selection: quality.select.clone(), cameras, unit: length };
        let moves_tokens = command.refine.steps().is_some_and(|steps| steps.tokens);
        let (result, tokens, _) = session.reconstruct_with_tokens(&model, &images, &request, moves_tokens)?;
        let mut scene = result.scene()?;
        let asked = command.cameras_out.is_some() && poses.is_none();
        let found =
            asked.then(|| session.stage("find cameras", |_| Ok(Placed::new(result.cameras(&scene, None)?, size))));
        let (found, found_in) = found.transpose()?.unzip();
        quality.prune(&mut scene, checkpoint.architecture());
        turned.iter().for_each(|first| scene.place(1.0, first));
        Ok(Forward {
            model,
            result,
            tokens,
            scene,
            found,
            turned: turned.is_some(),
            views: images.len(),
            size,
            all_tokens: shape.grid.tokens(),
            unit,
            precision,
            provenance: json!(checkpoint.provenance()),
            times: [("load photos", load_photos), (LOAD_WEIGHTS, load_weights)],
            found_in,
            weights: checkpoint.bytes(),
        })
    }
}
