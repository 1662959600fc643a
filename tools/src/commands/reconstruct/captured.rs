use super::Reconstruct;
use crate::{
    cameras::{EstimatedCameras, Finder, KnownCameras, Place},
    masks::MaskArgs,
    options::Network,
    photos::{self, Photographed},
    refinement::Initialization,
    session::Session,
    video::FrameFolder,
};
use std::path::PathBuf;
use zipsplat::{Error, Result, reconstruct::MAX_VIEWS};

impl Reconstruct {
    pub(super) fn finds(&self, network: &Network) -> bool {
        self.cameras.as_deref().is_some_and(KnownCameras::to_find) || self.finds_by_itself(network)
    }

    pub(super) fn finds_by_itself(&self, network: &Network) -> bool {
        let finder = self.cameras.as_deref().map(Finder::named);
        let Network::Pixels(checkpoint) = network else { return false };
        let by_network = |finder: Finder| finder.family() == Some(checkpoint.architecture().backbone.family);
        self.finding.depth_weights.is_none() && finder.is_none_or(|finder| finder.is_some_and(by_network))
    }

    /// Masks of photos whose cameras are not read from a file.
    pub(super) fn unposed(&self) -> Option<&MaskArgs> {
        let is_unposed = self.cameras.as_deref().is_none_or(KnownCameras::to_find);
        is_unposed.then_some(&self.finding.search.masks)
    }

    pub(super) fn captured(&self, session: &mut Session<'_>, network: &Network) -> Result<Photographed> {
        let named_in = self.cameras_out.as_deref().map(|file| (file, self.overwrite));
        let unposed = self.unposed();
        let (photos, mut folder) = self.input.list(session, self.views, unposed, named_in)?;
        if self.finds(network) {
            self.check_count(&photos, network)?;
        }
        let mut known = match (network, &self.cameras) {
            // One pass gives cameras and scene.
            (Network::Pixels(checkpoint), _) if self.finds_by_itself(network) => {
                let (poses, found) =
                    EstimatedCameras::by_predictor(session, &photos, self.predictor_options(checkpoint))?;
                session.note(format!("cameras found: {}", found.summary()));
                Some(KnownCameras { poses, found: Some(found) })
            }
            (_, Some(path)) => Some(KnownCameras::of(session, path, &photos, &self.finding)?),
            (_, None) => None,
        };
        if let (Some(place), Some(KnownCameras { poses, found: Some(found) })) = (&self.cameras_out, &known) {
            Place(place).save(poses, found)?;
            folder.iter_mut().for_each(FrameFolder::keep);
        }
        let views = self.views.filter(|_| unposed.is_none());
        let photos = photos::kept(session, photos, known.as_mut(), views)?;
        self.check_count(&photos, network)?;
        self.finding.masks().map_or(Ok(()), |masks| masks.check(&photos))?;
        Ok(Photographed { photos, known, folder })
    }

    /// Depth Anything 3 and VGGT have a limit; a refinement of points does without them.
    fn check_count(&self, photos: &[PathBuf], network: &Network) -> Result<()> {
        let from_points = self.refine.settings.init == Some(Initialization::Points);
        let from_points = from_points && self.refine.steps().is_some_and(|steps| !steps.tokens);
        if photos.len() > MAX_VIEWS && matches!(network, Network::Pixels(_)) && !from_points {
            let expected = format!(
                "1 to {MAX_VIEWS}; --views N takes N of them, evenly spread; --refine --init points takes any number"
            );
            return Err(Error::argument("views", photos.len(), expected));
        }
        Ok(())
    }
}
