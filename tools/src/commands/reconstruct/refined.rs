//! The refinement of `zipsplat reconstruct --refine`.

use super::{Forward, Posed, Reconstruct};
use crate::{
    photos,
    refinement::{self, Refinable, Start, Steps},
    session::Session,
};
use zipsplat::{
    Error, Result,
    gpu::{Arena, Device},
    refine::{FrozenHead, Refine, Refined, Stopped},
    types::{Camera, PointCloud, poses::Frame},
    weights::Checkpoint,
};

/// The thing that a refinement begins with.
#[derive(Clone, Copy)]
pub enum From {
    Scene(Start),
    Tokens,
}

/// The things that a refinement may need.
pub struct Given<'a> {
    pub device: &'a Device,
    /// The network's weights, where it has tokens.
    pub checkpoint: Option<&'a Checkpoint>,
    /// The network's results, where it ran.
    pub forward: Option<&'a Forward>,
}

/// The outcome of --refine.
pub struct Made {
    pub refined: Refined,
    /// The start, in words.
    pub started: String,
    /// The cameras that it was given.
    pub cameras: Vec<Camera>,
    pub request: Refine,
}

impl Reconstruct {
    /// The thing that these steps begin with.
    pub fn start_of(&self, steps: Steps, cloud: Option<&PointCloud>) -> From {
        if steps.tokens {
            From::Tokens
        } else {
            From::Scene(Start::or_best(self.refine.start, cloud, self.weights.is_embedded()))
        }
    }

    /// Makes the scene look like the photos, in the world of the first one's camera.
    ///
    /// # Errors
    /// As [`refinement::refine`], and where a photo or what it begins with is missing.
    pub fn refine_scene(
        &self,
        session: &mut Session<'_>,
        steps: Steps,
        start: From,
        given: Given<'_>,
        cloud: Option<&PointCloud>,
        Posed { photos, frames, .. }: Posed<'_>,
    ) -> Result<Made> {
        let world = frames[0].camera.pose;
        let camera = |frame: &&Frame| Camera { pose: frame.camera.pose.relative_to(&world), ..frame.camera };
        let cameras: Vec<Camera> = frames.iter().map(camera).collect();
        let (photos, _) =
            session.stage("load photos", |stage| photos::read(photos, frames, stage, |_, photo| Ok(photo)))?;
        let request = self.refine.request(steps);
        let arena = given.forward.and_then(|forward| forward.arena.clone());
        let arena = arena.unwrap_or_else(|| Arena::new(given.device));
        let tokens = given.forward.and_then(|forward| forward.tokens.as_ref());
        let (refined, started) = match (start, tokens.zip(given.checkpoint)) {
            (From::Tokens, Some((tokens, checkpoint))) => {
                let head = FrozenHead::load(given.device, checkpoint)?;
                let from = Refinable::Tokens(&head, tokens);
                (refinement::refine(session, &arena, from, &photos, &cameras, &request)?, refinement::TOKENS.to_owned())
            }
            (From::Tokens, None) => unreachable!("they were asked for"),
            (From::Scene(start), _) => {
                let scene = given.forward.map(|forward| forward.scene.clone());
                let scene = start.scene(scene, cloud, &cameras)?;
                let from = Refinable::Scene(&scene);
                (refinement::refine(session, &arena, from, &photos, &cameras, &request)?, start.name().to_owned())
            }
        };
        session.notes(refinement::doubt(&refined));
        match refined.stopped {
            Some(Stopped::Cancelled) if refined.best_step == 0 => Err(Error::Cancelled),
            _ => Ok(Made { refined, started, cameras, request }),
        }
    }
}
