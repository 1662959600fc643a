//! Reconstruction: photos to a scene.

use super::{
    camera::zs_camera,
    capture::zs_capture,
    image::zs_image,
    model::{report, zs_model, zs_progress},
    pointers::{borrow, produce, read_array, read_versioned},
    scene::{ModelTokens, PatchViews, zs_scene},
    status::{Failure, zs_status},
};
use rayon::prelude::*;
use std::{
    ffi::c_void,
    ops::{ControlFlow, Range},
};
use zipsplat::{
    Error,
    gpu::Progress,
    reconstruct::{MAX_VIEWS, Ratio, ReconstructOptions, Reconstruction, Shape, TokenSelection},
    types::{
        Camera, Pose,
        poses::SceneScale,
        preprocess::{View, fit, view_cameras},
    },
};

/// Selection of the tokens kept at ratios below 1.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_token_selection {
    /// The token nearest to each k-means centroid, as in the paper.
    ZS_TOKEN_SELECTION_KMEANS = 0,
    /// Evenly spaced.
    ZS_TOKEN_SELECTION_STRIDE = 1,
    /// Random, from `seed`.
    ZS_TOKEN_SELECTION_RANDOM = 2,
}

pub(super) type zs_token_selection_value = i32;

/// World of a scene.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_world {
    /// ZS_WORLD_INPUT_CAMERAS if `cameras` are given, else ZS_WORLD_FIRST_CAMERA.
    ZS_WORLD_AUTO = 0,
    /// The first photo's camera space.
    ZS_WORLD_FIRST_CAMERA = 1,
    /// The world of `cameras`, which are required.
    ZS_WORLD_INPUT_CAMERAS = 2,
}

pub(super) type zs_world_value = i32;

/// The paper's ratio: 0.5 sqrt(2 / number of photos).
pub const ZS_RATIO_AUTO: f64 = -1.0;

/// A scale estimated from the cameras and, if given, the capture's points.
pub const ZS_SCENE_SCALE_AUTO: f64 = 0.0;

/// Options of zs_reconstruct.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_reconstruct_options {
    /// sizeof(zs_reconstruct_options).
    pub struct_size: u32,
    /// World of the scene.
    pub world: zs_world_value,
    /// Fraction of tokens that become Gaussians, in (0, 1], or ZS_RATIO_AUTO; 0 is 1.
    pub ratio: f64,
    /// Scene scale: the length in units of `cameras` that the network treats as 1, or ZS_SCENE_SCALE_AUTO.
    /// The network expects a median distance of about 1 from the first camera.
    pub scene_scale: f64,
    /// Selection of the kept tokens.
    pub token_selection: zs_token_selection_value,
    /// Pooling for many photos: cross-view attention reads means of `kv_pool` x `kv_pool` patches,
    /// 1 to 4; 0 is 1. Larger values are faster and less exact.
    pub kv_pool: u32,
    /// Width and height of the network's input, multiples of the patch size: photos are
    /// center-cropped and resized. 0 and 0 are the model's own.
    pub input_size: [u32; 2],
    /// Seed for ZS_TOKEN_SELECTION_RANDOM.
    pub seed: u64,
    /// 0 or the number of photos.
    pub camera_count: usize,
    /// Known cameras of the whole photos.
    pub cameras: *const zs_camera,
    /// Progress callback.
    pub progress: zs_progress,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
    /// Capture whose points and cameras give the scale for ZS_SCENE_SCALE_AUTO; NULL uses `cameras` alone.
    pub capture: *const zs_capture,
}

versioned!(zs_reconstruct_options);

/// Reconstructs a scene from 1 to 192 photos of one place.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruct(
    model: *const zs_model,
    images: *const zs_image,
    image_count: usize,
    options: *const zs_reconstruct_options,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let reconstruct = || {
        // SAFETY: an object or NULL; a structure or NULL.
        let (zs_model { model, image_size, latest, head, .. }, options) =
            unsafe { (borrow(model, "model")?, read_versioned(options)?) };
        if !(1..=MAX_VIEWS).contains(&image_count) {
            return Err(Failure::argument("number of images", image_count, format!("1 to {MAX_VIEWS}")));
        }
        // SAFETY: the caller's arrays.
        let (images, cameras) = unsafe {
            (read_array(images, image_count, "images")?, read_array(options.cameras, options.camera_count, "cameras")?)
        };
        let (ratio, selection, unit) = (options.ratio()?, options.selection()?, options.unit()?);
        let [width, height] = match options.input_size {
            [0, 0] => [*image_size; 2],
            size => size,
        };
        // Validates everything before touching pixels.
        let pool = options.kv_pool.max(1) as usize;
        Shape::new(model.architecture(), image_count, [width, height], (ratio, &selection), !cameras.is_empty())?
            .pooled(pool)?;
        if !cameras.is_empty() && cameras.len() != images.len() {
            return Err(Failure::argument("number of cameras", cameras.len(), format!("0 or {image_count}")));
        }
        let cameras: Vec<Camera> = cameras.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
        let placed = options.placed(&cameras)?;
        let report_progress = |fraction, stage: &str| report(options.progress, options.user_data, fraction, stage);
        // SAFETY: the caller's pixels.
        let views = unsafe { prepare(&images, [width, height], |done| report_progress(PREPARED * done, "photos")) }?;
        // SAFETY: an object or NULL.
        let capture = unsafe { options.capture.as_ref() };
        let origin = cameras.first().map(|first| first.pose);
        let all: Vec<Pose> = cameras.iter().map(|camera| camera.pose).collect();
        let cameras = (!cameras.is_empty()).then(|| view_cameras(&cameras, &views)).transpose()?;
        let unit = match (&cameras, origin, capture) {
            (Some(views), Some(origin), Some(capture)) => capture.poses.scene_scale(unit, views, &origin)?.length,
            (Some(views), Some(origin), None) => SceneScale::of(unit, &all, None, views, &origin)?.length,
            _ => unit.unwrap_or(1.0),
        };
        let (images, maps): (Vec<_>, Vec<_>) = views.into_iter().map(|view| (view.image, view.map)).unzip();
        let unposed = cameras.is_none();
        let request = ReconstructOptions {
            ratio,
            token_selection: selection,
            cameras,
            scene_scale: Some(unit),
            kv_pool: pool,
            ..ReconstructOptions::default()
        };
        let report_progress = &report_progress;
        let progress = |of_all: Range<f64>| {
            move |now: Progress<'_>| {
                let done = of_all.start + (of_all.end - of_all.start) * now.fraction;
                report_progress(PREPARED + (1.0 - PREPARED) * done, now.scope)
            }
        };
        // Frees the previous scene's memory first.
        *latest.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = None;
        let (made, tokens) = match head {
            None => (model.reconstruct_views(&images, &request, progress(0.0..1.0))?, None),
            Some(head) => {
                let features = model.features(&images, &request, progress(0.0..0.8))?;
                let made = model.reconstruct_features(&features, &request, progress(0.8..0.9))?;
                let (tokens, head) = (model.tokens(&features, &request, progress(0.9..1.0))?, head.clone());
                (made, Some(ModelTokens { tokens, head, arena: model.arena().clone(), pose: placed }))
            }
        };
        let Reconstruction { gaussians, patches, .. } = made;
        let mut scene = gaussians.read()?;
        let seen = unposed.then_some(PatchViews { patches, maps });
        let made = match placed {
            None => zs_scene::on_device(scene, latest, gaussians).seen(seen),
            Some(pose) => {
                scene.place(1.0, &pose);
                scene.into()
            }
        };
        Ok(zs_scene { tokens, ..made })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, reconstruct) }
}

const PREPARED: f64 = 0.1;

/// `progress` runs on the calling thread.
///
/// # Safety
///
/// All pixels are readable.
unsafe fn prepare(
    images: &[zs_image],
    [width, height]: [u32; 2],
    progress: impl Fn(f64) -> ControlFlow<()>,
) -> Result<Vec<View>, Failure> {
    let view = |(i, image): (usize, &zs_image)| {
        // SAFETY: the caller's promise.
        let photo = unsafe { image.image(&format!("image {i}")) }?;
        Ok(fit(&photo, width, height)?)
    };
    let mut views = Vec::with_capacity(images.len());
    while views.len() < images.len() {
        if progress(views.len() as f64 / images.len() as f64).is_break() {
            return Err(Error::Cancelled.into());
        }
        let next = images.par_iter().enumerate().skip(views.len()).take(rayon::current_num_threads());
        let prepared: Vec<Result<View, Failure>> = next.map(view).collect();
        for view in prepared {
            views.push(view?);
        }
    }
    Ok(views)
}

impl zs_reconstruct_options {
    fn ratio(&self) -> Result<Ratio, Failure> {
        Ok(match self.ratio {
            ZS_RATIO_AUTO => Ratio::Auto,
            0.0 => Ratio::Fixed(1.0),
            ratio => Ratio::Fixed(ratio),
        })
    }

    /// Returns the scale; `None` is estimated from the cameras.
    fn unit(&self) -> Result<Option<f64>, Failure> {
        if self.scene_scale == ZS_SCENE_SCALE_AUTO {
            return Ok(None);
        }
        // Scenes are f32.
        if !(self.scene_scale as f32).is_normal() || self.scene_scale < 0.0 {
            return Err(Failure::argument("scene_scale", self.scene_scale, "a length above 0, or ZS_SCENE_SCALE_AUTO"));
        }
        Ok(Some(self.scene_scale))
    }

    /// Returns the first camera's pose in the scene's world, if the world is not that camera's
    /// space.
    fn placed(&self, cameras: &[Camera]) -> Result<Option<Pose>, Failure> {
        match (self.world, cameras.first()) {
            (0 | 2, Some(first)) => Ok(Some(first.pose)),
            (0 | 1, _) => Ok(None),
            (2, None) => {
                Err(Failure::argument("world", "ZS_WORLD_INPUT_CAMERAS without cameras", "a camera for each photo"))
            }
            (other, _) => Err(Failure::argument("world", other, "a zs_world")),
        }
    }

    fn selection(&self) -> Result<TokenSelection, Failure> {
        match self.token_selection {
            0 => Ok(TokenSelection::KMEANS),
            1 => Ok(TokenSelection::Stride),
            2 => Ok(TokenSelection::Random(self.seed)),
            other => Err(Failure::argument("token_selection", other, "a zs_token_selection")),
        }
    }
}
