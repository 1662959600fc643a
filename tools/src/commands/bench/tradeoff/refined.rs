use crate::{capture::ViewSplit, refinement::RefineTask, session::Stage};
use zipsplat::{
    Error, Result,
    reconstruct::{Model, ReconstructOptions},
    refine::{FrozenHead, RefineOptions, RefineResult, StopReason, refine_scene, refine_tokens},
    types::Scene,
    weights::Checkpoint,
};

pub fn refine(
    model: &Model,
    checkpoint: &Checkpoint,
    capture: &ViewSplit,
    request: &ReconstructOptions,
    scene: &Scene,
    steps: RefineTask,
    stage: &Stage<'_>,
) -> Result<RefineResult> {
    let (photos, cameras) = capture.training_views();
    let refine = RefineOptions { length: steps.length, ..RefineOptions::default() };
    let refined = if steps.tokens {
        let features = model.features(&capture.views.images, request, |_| stage.go_on())?;
        let tokens = model.tokens(&features, request, |_| stage.go_on())?;
        drop(features);
        let head = FrozenHead::load(model.arena().device(), checkpoint)?;
        refine_tokens(model.arena(), &head, &tokens, &photos, &cameras, &refine, |_| stage.go_on())?
    } else {
        refine_scene(model.arena(), scene, &photos, &cameras, &refine, |_| stage.go_on())?
    };
    match refined.stop_reason {
        Some(StopReason::Cancelled) => Err(Error::Cancelled),
        _ => Ok(refined),
    }
}
