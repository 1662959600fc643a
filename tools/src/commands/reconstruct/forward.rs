use super::{Posed, Reconstruct, placed::Placed};
use crate::{blocks, explain::Explanation, options::Size, session::Session, table::counted, views::Views};
use indicatif::HumanCount;
use serde_json::{Value, json};
use std::time::Duration;
use zipsplat::{
    Result,
    gpu::{Arena, Device},
    ops::Precision,
    reconstruct::{Model, Reconstruction, SceneTokens},
    stages::render::DeviceScene,
    types::{Pose, Scene, poses::SceneScale},
    weights::Checkpoint,
};

pub const LOAD_PHOTOS: &str = "load photos";
pub const LOAD_WEIGHTS: &str = "load weights";

#[derive(Default)]
pub struct Forward {
    pub arena: Option<Arena>,
    pub tokens: Option<SceneTokens>,
    pub scene: Scene,
    pub on_device: Option<DeviceScene>,
    pub found: Option<Placed>,
    /// Length in the cameras' unit that is 1 for the network.
    pub length: f64,
    pub times: Vec<(String, Duration)>,
    pub explanation: Option<Explanation>,
    pub peak_bytes: u64,
    pub views_summary: String,
    pub summary: String,
    pub rate: u64,
    pub json: Vec<(&'static str, Value)>,
    pub _model: Option<Model>,
}

impl Reconstruct {
    /// Returns the size of the network's input.
    pub fn check_views(&self, session: &mut Session<'_>, checkpoint: &Checkpoint, posed: Posed<'_>) -> Result<Size> {
        let Posed { photos, poses, frames } = posed;
        let (quality, crop) = (&self.quality, self.crop.crop);
        let size = quality.size_for(checkpoint);
        crop.check(size, poses.is_some())?;
        let shape = |views| quality.shape(checkpoint.architecture(), views, size, poses.is_some());
        self.blocks.check(crop.count(photos, frames)?, shape)?;
        session.notes(quality.doubt_size(checkpoint));
        if self.weights.is_builtin() && poses.is_none() && self.cameras_out.is_some() {
            session.note(
                "without --cameras the model that is built in sees all photos as if from one place: the cameras of --cameras-out fit \
                 its scene, not the photos' place; --cameras colmap finds those",
            );
        } else if self.weights.is_builtin() && poses.is_none() && photos.len() > 1 {
            session.note(
                "the model that is built in is a demonstration: several photos without cameras give colors and coarse shapes; \
                 --refine gives sharp scenes, with cameras by COLMAP; `zipsplat weights get zipsplat` gets the paper's weights",
            );
        }
        Ok(size)
    }
}

impl Forward {
    pub fn of_tokens(
        command: &Reconstruct,
        session: &mut Session<'_>,
        device: &Device,
        checkpoint: &Checkpoint,
        Posed { photos, poses, frames }: Posed<'_>,
        size: Size,
    ) -> Result<Self> {
        let (quality, crop) = (&command.quality, command.crop.crop);
        let (precision, arithmetic) = quality.arithmetic.choose(session, device)?;
        let masks = command.finding.masks();
        let (views, load_photos) =
            session.stage(LOAD_PHOTOS, |stage| crop.load(photos, frames, masks.as_ref(), size, stage))?;
        let Views { images, cameras, note } = views;
        session.notes(note);
        let scene_scale = match (poses, frames.first()) {
            (Some(poses), Some(first)) => Some(poses.scene_scale(command.scene_scale, &cameras, &first.camera.pose)?),
            _ => None,
        };
        session.notes(scene_scale.as_ref().and_then(SceneScale::doubt));
        let (cameras, turned) = crop.network_cameras(cameras);
        let (model, load_weights) = session.load_model(device, checkpoint, arithmetic)?;
        let length = scene_scale.as_ref().map_or(1.0, |scene_scale| scene_scale.length);
        let world = frames.first().map_or(Pose::IDENTITY, |first| first.camera.pose);
        let world = turned.map_or(world, |first| world.compose(&first));
        let mut request = quality.request(cameras, length);
        let blocks = command.blocks.choose(&model, images.len(), size, &mut request, |cameras, pose| match poses {
            Some(poses) => Ok(poses.scene_scale(command.scene_scale, cameras, &world.compose(pose))?.length),
            None => Ok(length),
        })?;
        let moves_tokens = command.refine.steps().is_some_and(|steps| steps.tokens);
        let ((result, tokens), _) = session.reconstruct(&model, &images, &blocks, &request, moves_tokens)?;
        session.notes(blocks::doubt(&result.seams));
        let mut scene = result.to_scene()?;
        let asked = command.cameras_out.is_some() && poses.is_none();
        let found =
            asked.then(|| session.stage("find cameras", |_| Ok(Placed { found: result.cameras(&scene, None)?, size })));
        let (found, found_in) = found.transpose()?.unzip();
        quality.prune(&mut scene, checkpoint.architecture());
        turned.iter().for_each(|first| scene.place(1.0, first));
        let as_made = turned.is_none() && result.gaussians.len() == scene.len();
        let each = result.gaussians.len() / result.tokens;
        let rate = rate(checkpoint.bytes(), load_weights);
        let all = images.len() * size.patches(checkpoint.architecture().patch_size);
        let mut summary = summary(&result, all, each, precision, scene_scale.as_ref(), found.as_ref());
        summary.extend(blocks::summary(&blocks, &result.seams).map(|summary| summary + "\n"));
        let json = vec![
            ("weights", json!(checkpoint.provenance())),
            ("views", json!(images.len())),
            ("blocks", blocks::as_json(&blocks, &result.seams)),
            ("width", json!(size.0)),
            ("height", json!(size.1)),
            ("tokens", json!(result.tokens)),
            ("all_tokens", json!(all)),
            ("unmasked_tokens", json!(result.unmasked.as_ref().map(Vec::len))),
            ("scene_scale", json!(length)),
            ("scene_scale_source", json!(scene_scale.as_ref().map(|scene_scale| &scene_scale.source))),
            ("gaussians_per_token", json!(each)),
            ("weights_bytes_per_second", json!(rate)),
            ("precision", json!(precision.name())),
            ("estimated_cameras", found.as_ref().map_or(json!(null), Placed::as_json)),
        ];
        let mut times = vec![(LOAD_PHOTOS.to_owned(), load_photos), (LOAD_WEIGHTS.to_owned(), load_weights)];
        times.extend(result.times.0.iter().cloned());
        times.extend(found_in.map(|took| ("find cameras".to_owned(), took)));
        Ok(Self {
            arena: Some(model.arena().clone()),
            tokens,
            scene,
            on_device: as_made.then(|| result.gaussians.clone()),
            found,
            length,
            times,
            explanation: Some(Explanation::of_stages(&result.times, &result.outline, result.skipped_passes.clone())),
            peak_bytes: result.peak_bytes,
            views_summary: format!(" from {} of {size}", counted(images.len(), "view")),
            summary,
            rate,
            json,
            _model: Some(model),
        })
    }
}

fn summary(
    result: &Reconstruction,
    all: usize,
    each: usize,
    precision: Precision,
    scene_scale: Option<&SceneScale>,
    found: Option<&Placed>,
) -> String {
    let (tokens, all, each) = (HumanCount(result.tokens as u64), counted(all, "token"), counted(each, "Gaussian"));
    let scene_scale = scene_scale.map(|scene_scale| format!("{scene_scale}\n")).unwrap_or_default();
    let cameras = found.map(Placed::summary).unwrap_or_default();
    format!("the network's: {tokens} of {all}, {each} each, {} precision\n{scene_scale}{cameras}", precision.name())
}

pub fn rate(bytes: u64, took: Duration) -> u64 {
    (bytes as f64 / took.as_secs_f64().max(1e-9)) as u64
}
