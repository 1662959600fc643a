//! Reconstruction: photos to a scene.

use super::{
    camera::{read_cameras, zs_camera},
    capture::zs_capture,
    image::zs_image,
    model::zs_model,
    pointers::{borrow, flag, meaning, optional_text, produce, read_array, read_versioned},
    progress::{Reporter, zs_progress_callback},
    reconstruction::{ModelTokens, zs_reconstruction},
    scene::zs_world_value,
    status::{Failure, zs_status},
};
use std::{
    ffi::{c_char, c_void},
    ops::{ControlFlow, Range},
    sync::Arc,
};
use zipsplat::{
    Camera, Progress, Ratio, ReconstructOptions, Reconstruction, SceneFrame, TokenSelection,
    reconstruct::{BackboneFeatures, BlockOptions, MAX_PHOTOS, MAX_VIEWS},
    types::preprocess::fit,
};

pub const ZS_MAX_VIEWS: usize = 192;

const _: () = assert!(ZS_MAX_VIEWS == MAX_VIEWS);

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_token_selection {
    ZS_TOKEN_SELECTION_KMEANS = 0,
    ZS_TOKEN_SELECTION_STRIDE = 1,
    ZS_TOKEN_SELECTION_RANDOM = 2,
    ZS_TOKEN_SELECTION_MUTUAL = 3,
}

pub(super) type zs_token_selection_value = i32;

pub const ZS_RATIO_AUTO: f64 = -1.0;

pub const ZS_SCENE_SCALE_AUTO: f64 = 0.0;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_reconstruct_options {
    pub struct_size: u32,
    pub world: zs_world_value,
    pub ratio: f64,
    pub scene_scale: f64,
    pub token_selection: zs_token_selection_value,
    pub keep_features: u32,
    pub input_size: [u32; 2],
    pub seed: u64,
    pub camera_count: usize,
    pub cameras: *const zs_camera,
    pub progress: zs_progress_callback,
    pub user_data: *mut c_void,
    pub capture: *const zs_capture,
    pub kv_pool: *const c_char,
    pub block_size: u32,
    pub block_overlap: u32,
}

versioned!(zs_reconstruct_options);

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
        let zs_model { model, head, .. } = zs_model;
        let keeps = flag("keep_features", options.keep_features)?;
        check_view_count(image_count, MAX_PHOTOS)?;
        // SAFETY: the caller's arguments.
        let (images, cameras, capture) = unsafe {
            let images = read_array(images, image_count, "images")?;
            (images, read_cameras(options.cameras, options.camera_count)?, options.capture.as_ref())
        };
        // SAFETY: the caller's strings.
        let wanted = unsafe { options.engine(cameras, capture) }?;
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
        // SAFETY: the caller's strings.
        let wanted = unsafe { options.engine(Vec::new(), None) }?;
        let (made, tokens) = model.decode(features, &wanted, progress)?;
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
        let Some(head) = self.head.clone() else {
            return Ok((self.model.reconstruct_features(features, options, progress)?, None));
        };
        let mut half = |now: Progress<'_>, start: f64| {
            let fraction = start + 0.5 * now.fraction;
            progress(Progress { fraction, ..now })
        };
        let made = self.model.reconstruct_features(features, options, |now| half(now, 0.0))?;
        let tokens = self.model.tokens(features, options, |now| half(now, 0.5))?;
        Ok((made, Some(ModelTokens { tokens, head })))
    }
}

pub(super) fn check_view_count(count: usize, most: usize) -> Result<(), Failure> {
    let expected = || format!("1 to {most}");
    let is_allowed = (1..=most).contains(&count);
    if is_allowed { Ok(()) } else { Err(Failure::argument("number of images", count, expected())) }
}

impl zs_reconstruct_options {
    /// # Safety
    /// As [`optional_text`], for `kv_pool`.
    unsafe fn engine(&self, cameras: Vec<Camera>, capture: Option<&zs_capture>) -> Result<ReconstructOptions, Failure> {
        let random = TokenSelection::Random(self.seed);
        let selections = [TokenSelection::KMEANS, TokenSelection::Stride, random, TokenSelection::MutualNearest];
        let worlds = [None, Some(SceneFrame::FirstCamera), Some(SceneFrame::InputCameras)];
        // SAFETY: the caller's promise.
        let kv_pool = unsafe { optional_text(self.kv_pool, "kv_pool") }?.unwrap_or("1");
        let wrong = |why: String| Failure::argument("kv_pool", kv_pool, why.trim_start_matches("expected "));
        Ok(ReconstructOptions {
            ratio: match self.ratio {
                ZS_RATIO_AUTO => Ratio::Auto,
                0.0 => Ratio::Fixed(1.0),
                ratio => Ratio::Fixed(ratio),
            },
            token_selection: meaning("token_selection", self.token_selection, "zs_token_selection", selections)?,
            cameras: (!cameras.is_empty()).then_some(cameras),
            scene_scale: (self.scene_scale != ZS_SCENE_SCALE_AUTO).then_some(self.scene_scale),
            capture: capture.map(|capture| capture.capture.clone()),
            world: meaning("world", self.world, "zs_world", worlds)?,
            input_size: (self.input_size != [0; 2]).then_some(self.input_size),
            kv_pool: kv_pool.parse().map_err(wrong)?,
            blocks: BlockOptions {
                size: (self.block_size > 0).then_some(self.block_size as usize),
                overlap: (self.block_overlap > 0).then_some(self.block_overlap as usize),
            },
        })
    }
}
