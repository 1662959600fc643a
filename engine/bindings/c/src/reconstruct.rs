//! Reconstruction: photos to a scene.

use super::{
    camera::zs_camera,
    capture::zs_capture,
    image::zs_image,
    model::zs_model,
    pointers::{borrow, produce, read_array, read_versioned},
    progress::{Reporter, zs_progress_callback},
    reconstruction::{ModelTokens, zs_reconstruction},
    scene::zs_world_value,
    status::{Failure, zs_status},
};
use std::{
    ffi::c_void,
    ops::{ControlFlow, Range},
    sync::Arc,
};
use zipsplat::{
    Camera, Progress, Ratio, ReconstructOptions, Reconstruction, SceneFrame, TokenSelection,
    reconstruct::{BackboneFeatures, BlockOptions, MAX_PHOTOS, MAX_VIEWS},
    types::preprocess::fit,
};

/// Maximum number of photos of one pass.
pub const ZS_MAX_VIEWS: usize = 192;

const _: () = assert!(ZS_MAX_VIEWS == MAX_VIEWS);

/// Token selection at ratios below 1.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_token_selection {
    /// The token nearest to each k-means centroid.
    ZS_TOKEN_SELECTION_KMEANS = 0,
    /// Evenly spaced.
    ZS_TOKEN_SELECTION_STRIDE = 1,
    /// Random, from `seed`.
    ZS_TOKEN_SELECTION_RANDOM = 2,
}

pub(super) type zs_token_selection_value = i32;

/// The paper's ratio: 0.5 sqrt(2 / number of photos).
pub const ZS_RATIO_AUTO: f64 = -1.0;

/// Scale estimated from the cameras and, if given, the capture's points.
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
    /// Length in units of `cameras` that the network treats as 1, or ZS_SCENE_SCALE_AUTO. The
    /// network expects a median distance of about 1 from the first camera.
    pub scene_scale: f64,
    /// Token selection.
    pub token_selection: zs_token_selection_value,
    /// Pooling for many photos: cross-view attention reads means of `kv_pool` x `kv_pool` patches,
    /// 1 to 4; 0 is 1. Larger values are faster and less exact.
    pub kv_pool: u32,
    /// Width and height of the network's input, multiples of the patch size; 0 and 0 are the
    /// model's own. Photos are center-cropped and resized.
    pub input_size: [u32; 2],
    /// Seed for ZS_TOKEN_SELECTION_RANDOM.
    pub seed: u64,
    /// 0 or the number of photos.
    pub camera_count: usize,
    /// Known cameras of the whole photos.
    pub cameras: *const zs_camera,
    /// Progress callback.
    pub progress: zs_progress_callback,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
    /// Capture whose points and cameras give ZS_SCENE_SCALE_AUTO; NULL uses `cameras` alone.
    pub capture: *const zs_capture,
    /// Whether to keep the backbone's features on the device, for zs_reconstruct_again and
    /// zs_reconstruction_get_patch_tokens: 0 or 1.
    pub keep_features: u32,
    /// Most photos of a pass, 1 to ZS_MAX_VIEWS; 0 is as many as the device's memory holds. More
    /// are split into overlapping blocks, by the cameras' positions or by order, and joined in one
    /// world. Neither features nor tokens are kept of several blocks.
    pub block_size: u32,
    /// Photos that neighboring blocks share; 0 is a quarter of the block.
    pub block_overlap: u32,
    /// 0.
    pub reserved: u32,
}

versioned!(zs_reconstruct_options);

/// Reconstructs a scene from 1 to 65,536 photos of one place.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruct(
    model: *const zs_model,
    images: *const zs_image,
    image_count: usize,
    options: *const zs_reconstruct_options,
    reconstruction: *mut *mut zs_reconstruction,
) -> zs_status {
    let reconstruct = || {
        // SAFETY: the caller's arguments.
        let (zs_model, options) = unsafe { (borrow(model, "model")?, read_versioned(options)?) };
        let (zs_model { model, head, .. }, keeps) = (zs_model, options.keeps_features()?);
        check_view_count(image_count, MAX_PHOTOS)?;
        // SAFETY: the caller's arguments.
        let (images, cameras, capture) = unsafe {
            let images = read_array(images, image_count, "images")?;
            (images, read_array(options.cameras, options.camera_count, "cameras")?, options.capture.as_ref())
        };
        let cameras = cameras.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
        let wanted = options.engine(cameras, capture)?;
        // SAFETY: the caller's pixels.
        let view = |i: usize, [width, height]: [u32; 2]| {
            fit(&unsafe { images[i].image(&format!("image {i}")) }?, width, height)
        };
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let within = |part: Range<f64>| {
            move |now: Progress<'_>| reporter.fraction(now.scope, part.start + (part.end - part.start) * now.fraction)
        };
        let prepared = model.prepare(image_count, &wanted, view, within(0.0..0.1))?;
        let (images, options, blocks) = (&prepared.images, &prepared.options, &prepared.blocks);
        let placement = Some(prepared.placement);
        let warning = prepared.warning.unwrap_or_default();
        let arena = model.arena().clone();
        if keeps && blocks.len() > 1 {
            let found = format!("1, with {} blocks of photos", blocks.len());
            return Err(Failure::argument("keep_features", found, "0, or photos of one block"));
        }
        if head.is_none() && !keeps || blocks.len() > 1 {
            let made = model.reconstruct_blocks(images, options, blocks, within(0.1..1.0))?;
            return Ok(zs_reconstruction::new(Reconstruction { placement, ..made }, None, arena, warning));
        }
        let features = model.features(images, options, within(0.1..0.8))?;
        let (made, tokens) = zs_model.decode(&features, options, within(0.8..1.0))?;
        let made = zs_reconstruction::new(Reconstruction { placement, ..made }, tokens, arena, warning);
        Ok(if keeps { made.with(Arc::new(features)) } else { made })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(reconstruction, reconstruct) }
}

/// Reconstructs a scene from the features of another reconstruction of the model, without another
/// pass of the backbone, with the bits of zs_reconstruct. Of `options` only `ratio`,
/// `token_selection`, `seed` and `progress` count.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruct_again(
    model: *const zs_model,
    reconstruction: *const zs_reconstruction,
    options: *const zs_reconstruct_options,
    again: *mut *mut zs_reconstruction,
) -> zs_status {
    let reconstruct = || {
        // SAFETY: the caller's arguments.
        let (model, first, options) =
            unsafe { (borrow(model, "model")?, borrow(reconstruction, "reconstruction")?, read_versioned(options)?) };
        let (features, arena) = (first.features()?, model.model.arena());
        if !arena.is(&first.arena) {
            return Err(Failure::argument("model", "another", "that of the reconstruction"));
        }
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let progress = |now: Progress<'_>| reporter.fraction(now.scope, now.fraction);
        let (made, tokens) = model.decode(features, &options.engine(Vec::new(), None)?, progress)?;
        let made = Reconstruction { placement: first.made.placement.clone(), ..made };
        Ok(zs_reconstruction::new(made, tokens, arena.clone(), first.warnings()).with(features.clone()))
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(again, reconstruct) }
}

impl zs_model {
    /// Returns a reconstruction, and the tokens of a model that refines them.
    fn decode(
        &self,
        features: &BackboneFeatures,
        options: &ReconstructOptions,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<(Reconstruction, Option<ModelTokens>), Failure> {
        let made = self.model.reconstruct_features(features, options, &mut progress)?;
        let Some(head) = self.head.clone() else { return Ok((made, None)) };
        let tokens = self.model.tokens(features, options, progress)?;
        Ok((made, Some(ModelTokens { tokens, head })))
    }
}

pub(super) fn check_view_count(count: usize, most: usize) -> Result<(), Failure> {
    let expected = || format!("1 to {most}");
    let is_allowed = (1..=most).contains(&count);
    if is_allowed { Ok(()) } else { Err(Failure::argument("number of images", count, expected())) }
}

impl zs_reconstruct_options {
    fn keeps_features(&self) -> Result<bool, Failure> {
        match (self.keep_features, self.reserved) {
            (keep @ (0 | 1), 0) => Ok(keep == 1),
            (0 | 1, other) => Err(Failure::argument("zs_reconstruct_options, reserved", other, "0")),
            (other, _) => Err(Failure::argument("keep_features", other, "0 or 1")),
        }
    }

    fn engine(&self, cameras: Vec<Camera>, capture: Option<&zs_capture>) -> Result<ReconstructOptions, Failure> {
        Ok(ReconstructOptions {
            ratio: match self.ratio {
                ZS_RATIO_AUTO => Ratio::Auto,
                0.0 => Ratio::Fixed(1.0),
                ratio => Ratio::Fixed(ratio),
            },
            token_selection: match self.token_selection {
                0 => TokenSelection::KMEANS,
                1 => TokenSelection::Stride,
                2 => TokenSelection::Random(self.seed),
                other => return Err(Failure::argument("token_selection", other, "a zs_token_selection")),
            },
            cameras: (!cameras.is_empty()).then_some(cameras),
            scene_scale: (self.scene_scale != ZS_SCENE_SCALE_AUTO).then_some(self.scene_scale),
            capture: capture.map(|capture| capture.capture.clone()),
            world: match self.world {
                0 => None,
                1 => Some(SceneFrame::FirstCamera),
                2 => Some(SceneFrame::InputCameras),
                other => return Err(Failure::argument("world", other, "a zs_world")),
            },
            input_size: (self.input_size != [0; 2]).then_some(self.input_size),
            kv_pool: self.kv_pool.max(1) as usize,
            blocks: BlockOptions {
                size: (self.block_size > 0).then_some(self.block_size as usize),
                overlap: (self.block_overlap > 0).then_some(self.block_overlap as usize),
            },
        })
    }
}
