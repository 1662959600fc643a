//! A capture as Gaussians, from its exact depth: what a perfect reconstruction of its surfaces would look like.

use super::Capture;
use zipsplat::{depth::add_view, types::Scene};

impl Capture {
    /// One round Gaussian for every pixel of every photo that shows a surface, in the capture's world.
    pub fn splats(&self) -> Scene {
        self.splats_of(0..self.images.len())
    }

    /// The same of some of the photos.
    pub fn splats_of(&self, views: impl Iterator<Item = usize>) -> Scene {
        let mut scene = Scene { sh_degree: 0, ..Scene::default() };
        views.for_each(|i| add_view(&mut scene, &self.cameras[i], &self.images[i], &self.depths[i]));
        scene
    }
}
