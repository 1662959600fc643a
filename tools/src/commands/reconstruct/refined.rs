use super::{Posed, Reconstruct, forward::Forward};
use crate::{
    options::Network,
    photos::PhotoFiles,
    refinement::{self, Initialization, Refinable, RefineTask},
    session::Session,
};
use std::time::Duration;
use zipsplat::{
    Result,
    gpu::{Arena, Device},
    refine::{FrozenHead, RefineOptions, RefineResult},
    types::{Camera, PointCloud},
};

#[derive(Clone, Copy)]
pub enum From {
    Scene(Initialization),
    Tokens,
}

pub struct RefineInputs<'a> {
    pub device: &'a Device,
    pub network: &'a Network,
    pub forward: Option<&'a Forward>,
    /// A rerun has equal photos and cameras.
    pub is_repeatable: bool,
}

pub struct RefinedScene {
    pub refined: RefineResult,
    pub started: &'static str,
    pub cameras: Vec<Camera>,
    pub request: RefineOptions,
    pub stereo_time: Option<Duration>,
}

impl Reconstruct {
    pub fn initialization(&self, steps: RefineTask, cloud: Option<&PointCloud>) -> From {
        if steps.tokens {
            From::Tokens
        } else {
            From::Scene(Initialization::or_best(self.refine.settings.init, cloud, self.weights.is_builtin()))
        }
    }

    /// World: the first camera.
    pub fn refine_scene(
        &self,
        session: &mut Session<'_>,
        steps: RefineTask,
        init: From,
        inputs: RefineInputs<'_>,
        cloud: Option<&PointCloud>,
        Posed { photos, frames, .. }: Posed<'_>,
    ) -> Result<RefinedScene> {
        let world = frames[0].camera.pose;
        let cameras: Vec<Camera> = frames.iter().map(|frame| frame.camera.relative_to(&world)).collect();
        let masks = self.finding.masks();
        let settings = &self.refine.settings;
        let known = settings.known_depth(session, photos, frames, &cameras, 1.0)?;
        let checkpoint = || refinement::checkpoint(self.output(), photos, masks.as_ref(), known.as_ref());
        let checkpoint = inputs.is_repeatable.then(checkpoint).transpose()?;
        let files = PhotoFiles::new(photos, frames, masks)?;
        let depth = known.as_ref().map(|known| known.kind);
        let request = RefineOptions { checkpoint, ..settings.request(steps, self.antialiasing, depth, photos) };
        let arena = inputs.forward.and_then(|forward| forward.arena.clone());
        let arena = arena.unwrap_or_else(|| Arena::new(inputs.device));
        let tokens = inputs.forward.and_then(|forward| forward.tokens.as_ref());
        let (head, scene);
        let mut stereo_time = None;
        let (from, started) = match (init, tokens, inputs.network) {
            (From::Tokens, Some(tokens), Network::Tokens(checkpoint)) => {
                head = FrozenHead::load(inputs.device, checkpoint)?;
                (Refinable::Tokens(&head, tokens), refinement::TOKENS)
            }
            (From::Tokens, ..) => unreachable!("they were asked for"),
            (From::Scene(init), ..) => {
                let network = inputs.forward.map(|forward| forward.scene.clone());
                let (initial, took) =
                    refinement::initial(session, init, network, cloud, &files, &cameras, settings.max_gaussians)?;
                (scene, stereo_time) = (initial, init.needs()[1].then_some(took));
                (Refinable::Scene(&scene), init.name())
            }
        };
        let refined = refinement::refine(session, &arena, from, files, known.as_ref(), &cameras, &request)?;
        Ok(RefinedScene { refined, started, cameras, request, stereo_time })
    }
}
