//! Measurements that change no result.

use super::{Kept, Refinement};
use crate::{
    Error, Result,
    gpu::Profile,
    refine::{Exposure, views::View},
    types::{ColorTransform, Image},
};

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

impl Refinement<'_> {
    /// Returns the mean PSNR with the kept cameras and exposures.
    pub fn training_psnr(&mut self) -> Result<f64> {
        let Kept { cameras, exposures, .. } = &self.kept;
        let (mut sum, mut seen) = (0.0, false);
        for view in &mut self.measured {
            view.camera.pose = cameras[view.photo].pose;
            let (drawn, intersections) = self.gaussians.draw(view)?;
            let drawn = exposures.as_ref().map(|all| all.get(view.photo).apply(&drawn)).unwrap_or(drawn);
            sum += view.psnr(&drawn);
            seen |= intersections > 0;
        }
        for photo in &self.training {
            if !seen {
                let (size, camera) = (self.photos.size(*photo, 1), self.photos.camera(*photo, &cameras[*photo], 1)?);
                let exposure = ColorTransform::IDENTITY;
                let image = Arc::new(Image { width: 0, height: 0, rgb: Vec::new(), mask: None });
                let view = View { photo: *photo, size, image, depth: None, camera, exposure };
                seen = self.gaussians.draw(&view)?.1 > 0;
            }
        }
        if !seen {
            let expected = "cameras in the scene's world that have some of it in front of them";
            return Err(Error::argument("scene to refine", "no Gaussian that any photo's camera sees", expected));
        }
        Ok(sum / self.measured.len() as f64)
    }

    /// Returns the time of a step at full size. Changes the Gaussians' moments.
    pub fn time_step(&mut self) -> Result<Duration> {
        let views = self.first_views()?;
        let views: Vec<&View> = views.iter().collect();
        // The first records and compiles.
        self.gaussians.step(&views, [0.0; 2])?;
        let begin = Instant::now();
        self.gaussians.step(&views, [0.0; 2])?;
        Ok(begin.elapsed())
    }

    /// Allocates the last step with the largest photo: earlier steps need less.
    pub(super) fn reserve(&mut self) -> Result<()> {
        let factor = self.schedule.factor(self.schedule.steps - 1, self.shortest());
        let pixels = |i: &&usize| self.photos.size(**i, factor).into_iter().map(u64::from).product::<u64>();
        let Some(largest) = self.training.iter().max_by_key(pixels).copied() else { return Ok(()) };
        let views = self.photos.views(self.cameras.all(), &[largest], &[], factor)?;
        let exposed = self.options.exposure == Exposure::On && self.first_exposed < self.schedule.steps;
        self.gaussians.reserve(&views[0], exposed)
    }

    pub(super) fn sizes(&self, factor: u32) -> impl Iterator<Item = [u32; 2]> {
        self.training.iter().map(move |i| self.photos.size(*i, factor))
    }

    pub(super) fn shortest(&self) -> u32 {
        self.sizes(1).flatten().min().unwrap_or(0)
    }

    fn first_views(&mut self) -> Result<Vec<View>> {
        let chosen = &self.training[..self.training.len().min(self.options.views_per_step)];
        self.photos.views(self.cameras.all(), chosen, &[], 1)
    }

    /// Of one step's first batch; none if memory lacks.
    pub(super) fn profile(&mut self) -> Result<Option<Profile>> {
        let views = self.first_views()?;
        match self.gaussians.profile(&views.iter().collect::<Vec<_>>()) {
            Err(Error::Memory { .. }) => Ok(None),
            profile => profile.map(Some),
        }
    }
}
