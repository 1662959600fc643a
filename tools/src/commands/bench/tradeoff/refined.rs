//! Refinements of a reconstruction.

use crate::{capture::Capture, refinement::Steps, session::Stage};
use std::ops::ControlFlow;
use zipsplat::{
    Error, Result,
    reconstruct::{Model, Request},
    refine::{FrozenHead, Refine, Refined, Stopped, refine_scene, refine_tokens},
    types::Scene,
    weights::Checkpoint,
};

/// Refines as `zipsplat eval --refine STEPS`.
pub fn refine(
    model: &Model,
    checkpoint: &Checkpoint,
    capture: &Capture,
    request: &Request,
    scene: &Scene,
    steps: Steps,
    stage: &Stage<'_>,
) -> Result<Refined> {
    let go_on = || stage.check().map_or(ControlFlow::Break(()), ControlFlow::Continue);
    let (photos, cameras) = capture.training_views();
    let refine = Refine { steps: steps.count, ..Refine::default() };
    let refined = if steps.tokens {
        let features = model.features(&capture.images(), request, |_| go_on())?;
        let tokens = model.tokens(&features, request, |_| go_on())?;
        drop(features);
        let head = FrozenHead::load(model.arena().device(), checkpoint)?;
        refine_tokens(model.arena(), &head, &tokens, &photos, &cameras, &refine, |_| go_on())?
    } else {
        refine_scene(model.arena(), scene, &photos, &cameras, &refine, |_| go_on())?
    };
    match refined.stopped {
        Some(Stopped::Cancelled) => Err(Error::Cancelled),
        _ => Ok(refined),
    }
}
