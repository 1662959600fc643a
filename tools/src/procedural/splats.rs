//! Gaussians of a capture's exact depth, a reference reconstruction.

use super::Capture;
use zipsplat::{depth::add_view, types::Scene};

impl Capture {
    /// Returns one isotropic Gaussian per surface pixel, in the capture's world.
    pub fn splats(&self) -> Scene {
        self.splats_of(0..self.images.len())
    }

    pub fn splats_of(&self, views: impl Iterator<Item = usize>) -> Scene {
        let mut scene = Scene { sh_degree: 0, ..Scene::default() };
        views.for_each(|i| add_view(&mut scene, &self.cameras[i], &self.images[i], &self.depths[i]));
        scene
    }
}
