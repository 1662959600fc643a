mod exposure;
mod initialization;
mod options;
mod report;

pub use initialization::Initialization;
pub use options::{DEFAULT_LENGTH, RefineArgs, RefineSettings, RefineTask, join_steps, parse_steps, with_cameras};
pub use report::{as_json, explain, summary};

use crate::{
    cameras::{Finder, Similarity, path_from},
    known_depth::{KnownDepth, WithDepth},
    outputs::make_folder,
    session::Session,
    stamp::{digest, stamp},
};
use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::Duration,
};
use zipsplat::{
    Error, Result,
    gpu::Arena,
    reconstruct::SceneTokens,
    refine::{
        FrozenHead, Photos, RefineCheckpoint, RefineOptions, RefineProgress, RefineResult, StopReason, refine_scene,
        refine_tokens,
    },
    types::{
        Camera, Masks, PointCloud, Pose, Scene,
        poses::{CaptureView, write_frames},
    },
};

pub const TOKENS: &str = "the network's tokens";

#[derive(Clone, Copy)]
pub enum Refinable<'a> {
    Scene(&'a Scene),
    Tokens(&'a FrozenHead, &'a SceneTokens),
}

/// Maps a point x to `pose(x) / unit`.
pub fn placed(mut cloud: PointCloud, pose: &Pose, unit: f64) -> PointCloud {
    for at in &mut cloud.positions {
        *at = (pose.transform(at.map(f64::from).into()) / unit).as_vec3().to_array();
    }
    cloud
}

/// [`Initialization::scene`] as a stage, and its time.
pub fn initial(
    session: &Session<'_>,
    init: Initialization,
    scene: Option<Scene>,
    cloud: Option<&PointCloud>,
    photos: &dyn Photos,
    cameras: &[Camera],
    most: Option<usize>,
) -> Result<(Scene, Duration)> {
    session.stage("stereo", |stage| init.scene(scene, cloud, photos, cameras, most, |done| stage.at(done)))
}

/// Returns whether a rerun has equal cameras, unlike COLMAP's.
pub fn has_stable_cameras(cameras: &Path) -> bool {
    Finder::named(cameras).is_none_or(|finder| finder.family().is_some())
}

/// Returns the checkpoint of a refinement, beside `output`.
pub fn checkpoint(
    output: &Path,
    photos: &[PathBuf],
    masks: Option<&Masks>,
    depth: Option<&KnownDepth>,
) -> Result<RefineCheckpoint> {
    let mut parts = vec![format!("{:?}", masks.map(|masks| masks.inverted))];
    parts.extend(depth.map(KnownDepth::stamps).transpose()?.into_iter().flatten());
    for photo in photos {
        parts.push(stamp(photo)?);
        parts.extend(masks.map(|masks| stamp(&masks.file(photo)?)).transpose()?);
    }
    let mut path = output.as_os_str().to_owned();
    path.push(".checkpoint");
    Ok(RefineCheckpoint::new(path.into(), digest(&parts)))
}

/// Fails if cancelled; removes the checkpoint unless the refinement failed.
pub fn conclude(
    session: &mut Session<'_>,
    output: &Path,
    request: &RefineOptions,
    refined: &RefineResult,
) -> Result<()> {
    if refined.stop_reason == Some(StopReason::Cancelled) {
        let (output, step, hint) = (output.display(), refined.best_step, report::hint_to_resume(request));
        session.note(format!("{output}: the best so far, after step {step}{hint}"));
        return Err(Error::Cancelled);
    }
    let is_needed = matches!(refined.stop_reason, Some(StopReason::Failed(_)));
    if let Some(checkpoint) = request.checkpoint.as_ref().filter(|_| !is_needed) {
        std::fs::remove_file(&checkpoint.path).ok();
    }
    Ok(())
}

/// Cancellation returns the best so far, if any.
pub fn refine(
    session: &mut Session<'_>,
    arena: &Arena,
    from: Refinable<'_>,
    photos: impl Photos,
    depth: Option<&KnownDepth>,
    cameras: &[Camera],
    request: &RefineOptions,
) -> Result<RefineResult> {
    let max_photo_bytes = session.device_options().max_memory_bytes.unwrap_or(u64::MAX).min(request.max_photo_bytes);
    let request = &RefineOptions { max_photo_bytes, ..request.clone() };
    let mut refined = None;
    let staged = session.stage("refine", |stage| {
        let progress = |at: RefineProgress<'_>| -> ControlFlow<()> {
            stage.name(&progress_message(&at));
            stage.at(at.step as f64 / at.steps as f64)
        };
        let photos = WithDepth { photos, depth, stage: Some(stage) };
        refined = Some(match from {
            Refinable::Scene(scene) => refine_scene(arena, scene, photos, cameras, request, progress)?,
            Refinable::Tokens(head, tokens) => refine_tokens(arena, head, tokens, photos, cameras, request, progress)?,
        });
        Ok(())
    });
    let refined = match (staged, refined) {
        (Ok(_) | Err(Error::Cancelled), Some(refined)) => refined,
        (staged, _) => return Err(staged.err().unwrap_or(Error::Cancelled)),
    };
    session.notes(report::doubt(&refined, request));
    match refined.stop_reason {
        Some(StopReason::Cancelled) if refined.best_step == 0 => Err(Error::Cancelled),
        _ => Ok(refined),
    }
}

fn progress_message(at: &RefineProgress<'_>) -> String {
    let psnr = at.psnr.map(|psnr| format!(", {psnr:.2} dB")).unwrap_or_default();
    format!("refine, loss {:.4}{psnr}", at.loss)
}

/// `to_world` maps the scene to the cameras' world. The file refers to `points` of that world if
/// they are a PLY.
pub fn save_cameras(
    path: &Path,
    refined: &RefineResult,
    to_world: &Similarity,
    photos: &[PathBuf],
    frames: &[&CaptureView],
    points: Option<&Path>,
) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    make_folder(folder)?;
    let moved = |((camera, photo), frame): ((&Camera, &PathBuf), &&CaptureView)| {
        let camera = Camera { intrinsics: frame.camera.intrinsics, ..to_world.apply(camera) };
        Ok(CaptureView { name: path_from(folder, photo)?, camera, ..CaptureView::clone(frame) })
    };
    let moved = refined.cameras.iter().zip(photos).zip(frames).map(moved).collect::<Result<Vec<CaptureView>>>()?;
    let is_ply = |points: &&Path| points.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("ply"));
    let points = points.filter(is_ply).and_then(|points| path_from(folder, points).ok());
    write_frames(path, &moved, points.as_deref())
}
