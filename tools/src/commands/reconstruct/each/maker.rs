//! Networks that make a capture's scene; one stays on the device.

use super::{Batch, Reconstruct};
use crate::{
    blocks,
    depth::{DepthPredictor, PreparedPhotos, check_finds_cameras},
    file_names,
    options::{DEPTH_WEIGHTS, Size, refuse},
    outputs,
    session::{Session, Stage},
    views::{Crop, Views},
};
use serde_json::{Value, json};
use std::path::PathBuf;
use zipsplat::{
    Result,
    gpu::Progress,
    reconstruct::{Block, MAX_VIEWS, Model, ReconstructOptions},
    types::{
        Camera, Image, Masks, Pose, Scene, World,
        poses::{Capture, CaptureView},
    },
    weights::{Checkpoint, DepthCheckpoint},
};

pub enum Input {
    Tokens(Box<TokenInput>),
    /// With the cameras' points file.
    Pixels(PreparedPhotos, Option<PathBuf>),
}

pub struct TokenInput {
    images: Vec<Image>,
    request: ReconstructOptions,
    blocks: Vec<Block>,
    /// Pose of the first camera, see [`Crop::network_cameras`].
    turned: Option<Pose>,
    note: Option<String>,
}

pub enum Maker<'a> {
    Tokens { model: Box<Model>, checkpoint: &'a Checkpoint, size: Size },
    Pixels(Box<DepthPredictor>),
}

pub struct FinishedScene {
    pub scene: Scene,
    /// From the maker only if the network estimated the cameras.
    pub world: Option<World>,
    /// The record; from the maker its network fields.
    pub record: Value,
}

impl<'a> Maker<'a> {
    /// Also returns a key of the settings.
    pub fn of_tokens(
        batch: &Batch<'_>,
        session: &mut Session<'_>,
        checkpoint: &'a Checkpoint,
    ) -> Result<(Self, String)> {
        let quality = &batch.command.quality;
        session.notes(checkpoint.notes());
        quality.check(checkpoint.architecture())?;
        let size = quality.size_for(checkpoint);
        batch.crop().check(size, batch.posed)?;
        session.notes(quality.doubt_size(checkpoint));
        outputs::make_folder(batch.command.output())?;
        let device = session.device()?;
        let (precision, arithmetic) = quality.arithmetic.choose(session, &device)?;
        let (model, _) = session.load_model(&device, checkpoint, arithmetic)?;
        let settings_key = batch.settings_key(checkpoint.provenance(), &size.to_string(), precision.name())?;
        Ok((Self::Tokens { model: Box::new(model), checkpoint, size }, settings_key))
    }

    pub fn of_pixels(
        batch: &Batch<'_>,
        session: &mut Session<'_>,
        checkpoint: &DepthCheckpoint,
    ) -> Result<(Self, String)> {
        let quality = &batch.command.quality;
        let squares = batch.crop() == Crop::Tiles;
        refuse("--crop tiles", squares, DEPTH_WEIGHTS, "weights of ZipSplat")?;
        quality.check_pixels(checkpoint)?;
        if !batch.posed {
            check_finds_cameras(checkpoint.architecture())?;
        }
        outputs::make_folder(batch.command.output())?;
        let device = session.device()?;
        let options = batch.command.predictor_options(checkpoint);
        let size = format!("{:?}", options.side);
        let predictor = options.open(session, &device)?;
        let settings_key = batch.settings_key(checkpoint.provenance(), &size, predictor.precision.name())?;
        Ok((Self::Pixels(Box::new(predictor)), settings_key))
    }

    /// Returns true if the network takes this number of photos, in any number of passes.
    pub fn takes(&self, photos: usize) -> bool {
        photos > 0 && (photos <= MAX_VIEWS || matches!(self, Self::Tokens { .. }))
    }

    pub fn prepare(
        &self,
        batch: &Batch<'_>,
        photos: &[PathBuf],
        poses: Option<&Capture>,
        frames: &[&CaptureView],
        masks: Option<&Masks>,
        stage: &Stage<'_>,
    ) -> Result<Input> {
        match self {
            Self::Tokens { size, model, .. } => {
                let crop = batch.crop();
                let Views { images, cameras, note } = crop.load(photos, frames, masks, *size, stage)?;
                let notes: Vec<String> = poses.iter().flat_map(|poses| &poses.warnings).cloned().chain(note).collect();
                let note = (!notes.is_empty()).then(|| notes.join("; "));
                let world = frames.first().map_or(Pose::IDENTITY, |first| first.camera.pose);
                let scale = |cameras: &[Camera], pose: &Pose| match poses {
                    Some(poses) => Ok(poses.scene_scale(None, cameras, &world.compose(pose))?.length),
                    None => Ok(1.0),
                };
                let unit = scale(&cameras, &Pose::IDENTITY)?;
                let (cameras, turned) = crop.network_cameras(cameras);
                let Reconstruct { quality, blocks, .. } = batch.command;
                let mut request = quality.request(cameras, unit);
                let first = turned.unwrap_or(Pose::IDENTITY);
                let scale = |cameras: &[Camera], pose: &Pose| scale(cameras, &first.compose(pose));
                let blocks = blocks.choose(model, images.len(), *size, &mut request, scale)?;
                Ok(Input::Tokens(Box::new(TokenInput { images, request, blocks, turned, note })))
            }
            Self::Pixels(predictor) => {
                let points = poses.and_then(|poses| poses.points.clone());
                Ok(Input::Pixels(predictor.prepare(photos, frames, masks, stage)?, points))
            }
        }
    }

    pub fn make(&self, batch: &Batch<'_>, input: Input, stage: &Stage<'_>) -> Result<FinishedScene> {
        match (input, self) {
            (Input::Tokens(input), Self::Tokens { model, checkpoint, .. }) => {
                let TokenInput { images, request, blocks, turned, note } = *input;
                let follow = |progress: Progress<'_>| stage.at(progress.fraction);
                let made = model.reconstruct_blocks(&images, &request, &blocks, follow)?;
                let mut scene = made.to_scene()?;
                batch.command.quality.prune(&mut scene, checkpoint.architecture());
                turned.iter().for_each(|first| scene.place(1.0, first));
                let note = note.into_iter().chain(blocks::doubt(&made.seams)).reduce(|all, next| all + "; " + &next);
                let record = json!({
                    "scene_scale": request.scene_scale, "tokens": made.tokens, "note": note,
                    "blocks": blocks::as_json(&blocks, &made.seams),
                });
                Ok(FinishedScene { scene, world: None, record })
            }
            (Input::Pixels(prepared, points), Self::Pixels(predictor)) => {
                let mut predicted = predictor.predict(prepared, stage)?;
                predicted.scale(false, points.as_deref())?;
                let pose = predicted.cameras.iter().flatten().next().map_or(Pose::IDENTITY, |camera| camera.pose);
                let scene = predicted.scene(&pose, batch.command.quality.kept())?;
                let world = World::of_first(&predicted.frames()?.iter().collect::<Vec<_>>());
                if !predicted.lost.is_empty() {
                    predicted
                        .notes
                        .push(format!("without a camera, and left out: {}", file_names::names(&predicted.lost)));
                }
                let note = (!predicted.notes.is_empty()).then(|| predicted.notes.join("; "));
                let record = json!({ "network": predicted.network, "tokens": predicted.patches()[0], "note": note });
                Ok(FinishedScene { scene, world, record })
            }
            _ => unreachable!("photos are prepared for the network that there is"),
        }
    }
}
