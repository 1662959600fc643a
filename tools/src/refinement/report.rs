use super::{RefineSettings, TOKENS};
use crate::table::{Table, bytes, counted, significant, time};
use glam::DQuat;
use serde_json::{Value, json};
use std::path::PathBuf;
use zipsplat::{
    refine::{DepthKind, DepthLoss, LearningRates, RefineOptions, RefineResult, StopReason},
    types::{Camera, Pose, median},
};

/// Medians of the moved cameras: rotation in degrees, and shift.
fn camera_movement(given: &[Camera], refined: &RefineResult) -> Option<[f64; 2]> {
    let pairs = given.iter().zip(&refined.cameras).filter(|(given, refined)| given != refined);
    let movements: Vec<Pose> = pairs.map(|(given, refined)| refined.pose.relative_to(&given.pose)).collect();
    let median = |of: fn(&Pose) -> f64| median(movements.iter().map(of));
    let degrees = median(|pose| DQuat::from_mat3(&pose.rotation).to_scaled_axis().length().to_degrees());
    Some([degrees?, median(|pose| pose.translation.length())?])
}

pub fn summary(refined: &RefineResult, start: &str, given: &[Camera]) -> String {
    let (steps, step, [after, before]) = (refined.losses.len(), refined.best_step, refined.training_psnr);
    let training = counted(given.len() - refined.holdout_views.len(), "training photo");
    let psnr = refined.psnr().map(|[after, before]| format!("; held-out {before:.2} to {after:.2} dB"));
    let cameras = camera_movement(given, refined).map(|[degrees, distance]| {
        format!("; cameras turned by {degrees:.2} degrees and moved by {} (medians)", significant(distance))
    });
    let resumed = match refined.resumed_step {
        0 => String::new(),
        step => format!(", resumed after step {step}"),
    };
    format!(
        "refined from {start} in {}: kept is step {step} of {steps}{resumed}; {training} {before:.2} to {after:.2} dB{}{}{}",
        time(refined.took),
        psnr.unwrap_or_default(),
        cameras.unwrap_or_default(),
        masked(refined).map(|percent| format!("; masks ignore {percent} of the pixels")).unwrap_or_default()
    )
}

pub fn as_json(refined: &RefineResult, start: &str, given: &[Camera]) -> Value {
    let cameras = camera_movement(given, refined);
    json!({
        "init": start,
        "camera_movement": cameras.map(|[degrees, distance]| json!({ "rotation_deg": degrees, "translation": distance })),
        "exposures": refined.exposures.as_ref().map(|all| all.iter().map(|exposure| exposure.0).collect::<Vec<_>>()),
        "masked_fraction": refined.masked_fraction, "depth_fraction": refined.depth_fraction, "training_psnr": { "initial": refined.training_psnr[1], "best": refined.training_psnr[0] },
        "holdout_psnr": refined.psnr().map(|[best, initial]| json!({ "initial": initial, "best": best })),
        "steps": refined.losses.len(), "resumed_step": refined.resumed_step, "best_step": refined.best_step, "losses": refined.losses,
        "holdout_psnr_by_step": refined.holdout_psnr, "holdout_views": refined.holdout_views, "sizes": refined.sizes,
        "stop_reason": ended(refined),
        "seconds": refined.took.as_secs_f64(), "peak_bytes": refined.peak_bytes, "photo_bytes": refined.photo_bytes,
    })
}

pub fn explain(
    refined: &RefineResult,
    request: &RefineOptions,
    settings: &RefineSettings,
    start: &str,
    photos: &[PathBuf],
) -> Table {
    let name = |i: &usize| photos[*i].file_name().unwrap_or_default().to_string_lossy().into_owned();
    let held: Vec<String> = refined.holdout_views.iter().map(name).collect();
    let size = |(step, [width, height]): &(usize, [u32; 2])| format!("{width}x{height} from step {}", step + 1);
    let sizes: Vec<String> = refined.sizes.iter().map(size).collect();
    let LearningRates { means, scales, quats, opacities, sh_coeffs, sh_higher, tokens, .. } = request.learning_rates;
    let LearningRates { camera_rotation, camera_translation, exposure, .. } = request.learning_rates;
    let mut rates = match start {
        TOKENS => format!("tokens {tokens}"),
        _ => format!(
            "means {means} of the scene's distance, ln scales {scales}, quats {quats}, logit opacities {opacities}, \
             colors {sh_coeffs}, higher harmonics {sh_higher}"
        ),
    };
    if request.optimize_cameras {
        rates +=
            &format!(", camera rotations {camera_rotation}, translations {camera_translation} of the scene's distance");
    }
    if refined.exposures.is_some() {
        rates += &format!(", exposures {exposure} times the steps between uses of a photo");
    }
    let (steps, each) = (refined.losses.len(), request.views_per_step.min(photos.len() - refined.holdout_views.len()));
    let or_none = |list: String| if list.is_empty() { "none".into() } else { list };
    let mut table = Table::new(2, &["refined", ""]);
    for (what, value) in [
        ("init", start.to_owned()),
        (
            "steps",
            format!(
                "{steps} of {}, of {} each; kept is step {}",
                refined.steps,
                counted(each, "photo"),
                refined.best_step
            ),
        ),
        ("rates", format!("{rates}; less for more than 100 steps; they fall to a tenth")),
        ("held-out photos", or_none(held.join(", "))),
        ("largest photo", or_none(sizes.join(", "))),
        ("masked", masked(refined).unwrap_or("none".into())),
        ("exposures", settings.exposure_rule(photos, refined)),
        ("depth", depth(refined, request).unwrap_or("none".into())),
        ("memory", format!("{}, and {} of photos on the host", bytes(refined.peak_bytes), bytes(refined.photo_bytes))),
        ("stop reason", ended(refined)),
    ] {
        table.row([what.into(), value]);
    }
    table
}

fn masked(refined: &RefineResult) -> Option<String> {
    (refined.masked_fraction > 0.0).then(|| format!("{:.1} %", 100.0 * refined.masked_fraction))
}

fn depth(refined: &RefineResult, request: &RefineOptions) -> Option<String> {
    let DepthLoss { weight, kind } = request.depth_loss?;
    let kind = match kind {
        DepthKind::Metric => "in the cameras' unit",
        DepthKind::Relative => "relative, fitted to each photo",
    };
    let percent = 100.0 * refined.depth_fraction;
    Some(format!("{percent:.1} % of the pixels, {kind}; weight {weight}, which falls to a hundredth"))
}

fn ended(refined: &RefineResult) -> String {
    match &refined.stop_reason {
        None => "after all steps".into(),
        Some(StopReason::Cancelled) => "cancelled".into(),
        Some(StopReason::Diverged(why) | StopReason::Failed(why)) => why.clone(),
    }
}

/// Photos below which refinement overfits.
const FEW: usize = 6;

/// Empty without a checkpoint.
pub(super) fn hint_to_resume(request: &RefineOptions) -> &'static str {
    if request.checkpoint.is_some() { "; the same command continues" } else { "" }
}

pub(super) fn doubt(refined: &RefineResult, request: &RefineOptions) -> Option<String> {
    let training = refined.cameras.len() - refined.holdout_views.len();
    match &refined.stop_reason {
        None if refined.holdout_views.is_empty() && training < FEW && refined.best_step > 0 => Some(format!(
            "only {} to refine against, and none held out: other views may look worse than before; more photos help, and \
             --holdout-views 1 measures it",
            counted(training, "photo")
        )),
        Some(reason @ (StopReason::Diverged(why) | StopReason::Failed(why))) => {
            let remedy = if matches!(reason, StopReason::Failed(_)) { hint_to_resume(request) } else { "" };
            Some(format!(
                "the refinement ended early: {why}; the scene after step {} is kept{remedy}",
                refined.best_step
            ))
        }
        _ => None,
    }
}
