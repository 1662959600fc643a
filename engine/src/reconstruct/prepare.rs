use super::{Block, Model, ReconstructOptions, Reconstruction, SceneFrame};
use crate::{
    Error, Result,
    gpu::Progress,
    types::{
        Camera, Image, Pose,
        poses::SceneScale,
        preprocess::{PixelMap, View, fit, view_cameras},
    },
};
use rayon::prelude::*;
use std::ops::ControlFlow;

const PREPARATION: f64 = 0.1;

/// Network views of photos, with options in their terms.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Images of one size, for [`Model::reconstruct_views`] and [`Model::features`].
    pub images: Vec<Image>,
    /// Options for the views.
    pub options: ReconstructOptions,
    /// Blocks of views, a pass each.
    pub blocks: Vec<Block>,
    /// Relation to the photos.
    pub placement: Placement,
    /// Warning about an estimated scene scale.
    pub warning: Option<String>,
}

/// Relation of a reconstruction to its photos.
#[derive(Clone, Debug)]
pub struct Placement {
    /// Maps from photos to views.
    pub maps: Vec<PixelMap>,
    /// Pose of the first camera in the scene's world, unless that is its frame.
    pub pose: Option<Pose>,
}

impl Model {
    /// Reconstructs a scene from photos of any size.
    ///
    /// # Errors
    /// [`Error::Argument`] for unusable photos, cameras or options; [`Error::Memory`];
    /// [`Error::Cancelled`] by `progress`.
    pub fn reconstruct(
        &self,
        photos: &[Image],
        options: &ReconstructOptions,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        let view = |i: usize, [width, height]: [u32; 2]| fit(&photos[i], width, height);
        let prepared = self.prepare(photos.len(), options, view, |now| {
            progress(Progress { fraction: PREPARATION * now.fraction, ..now })
        })?;
        let Prepared { images, options, blocks, placement, .. } = prepared;
        let made = self.reconstruct_blocks(&images, &options, &blocks, |now| {
            progress(Progress { fraction: PREPARATION + (1.0 - PREPARATION) * now.fraction, ..now })
        })?;
        Ok(Reconstruction { placement: Some(placement), ..made })
    }

    /// Prepares `count` photos, which `view` opens and fits to a size. Checks options first.
    ///
    /// # Errors
    /// Those of [`Model::reconstruct`] and `view`.
    pub fn prepare(
        &self,
        count: usize,
        options: &ReconstructOptions,
        view: impl Fn(usize, [u32; 2]) -> Result<View> + Sync,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Prepared> {
        let size = options.input_size.unwrap_or([self.image_size; 2]);
        let layout = self.block_layout(count, size, options)?;
        let cameras = options.cameras.as_deref();
        if let Some(cameras) = cameras
            && cameras.len() != count
        {
            return Err(Error::argument("cameras", cameras.len(), format!("{count}, one a photo")));
        }
        let first = cameras.map(|cameras| cameras[0].pose);
        let pose = match options.world {
            Some(SceneFrame::InputCameras) if first.is_none() => {
                return Err(Error::argument("world", "input cameras, without cameras", "a camera for each photo"));
            }
            Some(SceneFrame::FirstCamera) => None,
            Some(SceneFrame::InputCameras) | None => first,
        };
        let mut views = Vec::with_capacity(count);
        while views.len() < count {
            let fraction = views.len() as f64 / count as f64;
            if progress(Progress { scope: "photos", fraction }).is_break() {
                return Err(Error::Cancelled);
            }
            let next = views.len()..count.min(views.len() + rayon::current_num_threads());
            for view in next.into_par_iter().map(|i| view(i, size)).collect::<Vec<_>>() {
                views.push(view?);
            }
        }
        let of_views = cameras.map(|cameras| view_cameras(cameras, &views)).transpose()?;
        let scale_of = |views: &[Camera], pose: &Pose| {
            let cameras = cameras.unwrap_or_default();
            let (given, origin) = (options.scene_scale, cameras[0].pose.compose(pose));
            match &options.capture {
                Some(capture) => capture.scene_scale(given, views, &origin),
                None => {
                    let poses: Vec<Pose> = cameras.iter().map(|camera| camera.pose).collect();
                    SceneScale::of(given, &poses, None, views, &origin)
                }
            }
        };
        let scale = of_views.as_deref().map(|of_views| scale_of(of_views, &Pose::IDENTITY)).transpose()?;
        let warning = scale.as_ref().and_then(SceneScale::doubt);
        let scene_scale = scale.map(|scale| scale.length).or(options.scene_scale);
        let blocks = layout.blocks(of_views.as_deref(), scene_scale.unwrap_or(1.0), |views, pose| {
            scale_of(views, pose).map(|scale| scale.length)
        })?;
        let (images, maps) = views.into_iter().map(|view| (view.image, view.map)).unzip();
        let options = ReconstructOptions { cameras: of_views, scene_scale, ..options.clone() };
        Ok(Prepared { images, options, blocks, placement: Placement { maps, pose }, warning })
    }
}
