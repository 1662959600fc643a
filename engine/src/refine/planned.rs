//! The plans of a step: photos of one size drawn, compared, and their gradients added up.

use super::views::View;
use crate::{
    Result,
    gpu::{Run, Tensor},
    stages::render::{CAMERA_NUMBERS, CameraRows, FrameShape, RenderOutputs, camera_rows},
};

/// A plan that draws photos' cameras and, where it learns from the photos, adds to the gradients.
pub(super) struct Planned {
    pub shape: FrameShape,
    /// Room for intersections.
    pub capacity: usize,
    pub run: Run,
    pub cameras: Tensor,
    pub learning: Option<Learning>,
    pub outputs: RenderOutputs,
}

#[derive(Clone, Copy)]
pub(super) struct Learning {
    /// `[cameras, height, width, 3]`.
    pub targets: Tensor,
    /// `[cameras]`.
    pub losses: Tensor,
    /// `[cameras, 10]`, where cameras are moved, too.
    pub d_cameras: Option<Tensor>,
}

/// What a step found of a photo.
pub(super) struct Found {
    /// The index of the photo.
    pub photo: usize,
    pub loss: f32,
    /// The gradient of its camera, d loss / d (w, v), where cameras are moved, too.
    pub d_pose: Option<[f32; 6]>,
}

/// Bytes of the largest list of a picture's intersections, for each.
pub(super) fn intersection_bytes(learns: bool) -> u64 {
    // The backward pass has six moments.
    if learns { 24 } else { 4 }
}

impl Planned {
    /// Gives it its cameras and photos.
    pub fn write(&mut self, views: &[&View]) -> Result<()> {
        let cameras: Vec<CameraRows> = views.iter().map(|view| camera_rows(&view.camera)).collect();
        self.run.write(self.cameras, &cameras)?;
        if let Some(Learning { targets, .. }) = self.learning {
            let values: Vec<f32> = views.iter().flat_map(|view| view.values()).collect();
            self.run.write(targets, &values)?;
        }
        Ok(())
    }

    /// What its run found of these photos.
    pub fn found(&self, views: &[&View]) -> Result<Vec<Found>> {
        let Learning { losses, d_cameras, .. } = self.learning.expect("it learns");
        let losses: Vec<f32> = self.run.read(losses)?;
        let poses: Option<Vec<[f32; CAMERA_NUMBERS]>> = d_cameras.map(|tensor| self.run.read(tensor)).transpose()?;
        let pose = |i: usize| poses.as_ref().map(|all| std::array::from_fn(|k| all[i][k]));
        let of = |(i, view): (usize, &&View)| Found { photo: view.photo, loss: losses[i], d_pose: pose(i) };
        Ok(views.iter().enumerate().map(of).collect())
    }
}
