//! Reconstructions.

use super::{
    camera::zs_camera,
    image::zs_pixel_values,
    pointers::{Versioned, borrow, c_text, describe, destroy, element, produce},
    scene::zs_scene,
    status::{Failure, zs_status},
};
use std::{
    ffi::{CString, c_char},
    ptr::null,
    sync::{Arc, OnceLock},
};
use zipsplat::{
    Error, Reconstruction, Result, Scene,
    features::PixelValues,
    gpu::Arena,
    reconstruct::{BackboneFeatures, SceneTokens},
    refine::FrozenHead,
};

pub struct zs_reconstruction {
    pub(super) made: Reconstruction,
    pub(super) tokens: Option<ModelTokens>,
    pub(super) arena: Arena,
    features: Option<Arc<BackboneFeatures>>,
    patch_tokens: OnceLock<Vec<PixelValues>>,
    warnings: CString,
    scene: OnceLock<Arc<Scene>>,
    estimates: OnceLock<Vec<Estimate>>,
}

pub(super) struct ModelTokens {
    pub tokens: SceneTokens,
    pub head: Arc<FrozenHead>,
}

/// Camera, if found, number of inliers, number of patches.
struct Estimate(Option<zs_camera>, u32, u32);

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_reconstruction_info {
    pub struct_size: u32,
    pub has_tokens: u32,
    pub view_count: usize,
    pub token_count: usize,
    pub gaussian_count: usize,
    pub warnings: *const c_char,
    pub channel_count: usize,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_camera_estimate {
    pub struct_size: u32,
    pub inliers: u32,
    pub patches: u32,
    pub reserved: u32,
    pub camera: *const zs_camera,
}

versioned!(zs_reconstruction_info, zs_camera_estimate { reserved });

impl zs_reconstruction {
    pub(super) fn new(made: Reconstruction, tokens: Option<ModelTokens>, arena: Arena, warnings: String) -> Self {
        let warnings = c_text(&warnings);
        Self {
            made,
            tokens,
            arena,
            features: None,
            patch_tokens: OnceLock::new(),
            warnings,
            scene: OnceLock::new(),
            estimates: OnceLock::new(),
        }
    }

    pub(super) fn with(self, features: Arc<BackboneFeatures>) -> Self {
        Self { features: Some(features), ..self }
    }

    pub(super) fn features(&self) -> Result<&Arc<BackboneFeatures>, Failure> {
        let expected = "one of zs_reconstruct with keep_features = 1";
        self.features.as_ref().ok_or_else(|| Failure::argument("reconstruction", "one without features", expected))
    }

    pub(super) fn warnings(&self) -> String {
        self.warnings.to_string_lossy().into_owned()
    }

    /// Reads patch tokens from the device once.
    fn patch_tokens(&self) -> Result<&[PixelValues], Failure> {
        match self.patch_tokens.get() {
            Some(tokens) => Ok(tokens),
            None => {
                let tokens = self.features()?.patch_tokens()?;
                Ok(self.patch_tokens.get_or_init(|| tokens))
            }
        }
    }

    /// Reads the scene from the device once.
    pub(super) fn scene(&self) -> Result<&Arc<Scene>> {
        match self.scene.get() {
            Some(scene) => Ok(scene),
            None => {
                let scene = self.made.to_scene()?.into();
                Ok(self.scene.get_or_init(|| scene))
            }
        }
    }

    fn estimates(&self) -> Result<&[Estimate]> {
        if let Some(found) = self.estimates.get() {
            return Ok(found);
        }
        let mut found = self.made.cameras(self.scene()?, None)?;
        if found.iter().all(Result::is_err) {
            return Err(found.swap_remove(0).err().unwrap_or(Error::Cancelled));
        }
        let estimate = |found: Result<zipsplat::cameras::CameraEstimate>| match found {
            Ok(found) => Estimate(Some((&found.camera).into()), found.inliers as u32, found.pairs as u32),
            Err(_) => Estimate(None, 0, 0),
        };
        let found = found.into_iter().map(estimate).collect();
        Ok(self.estimates.get_or_init(|| found))
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_get_info(
    reconstruction: *const zs_reconstruction,
    info: *mut zs_reconstruction_info,
) -> zs_status {
    let of = |zs_reconstruction { made, tokens, features, warnings, .. }: &zs_reconstruction| {
        let token_count = made.unmasked.as_ref().map_or(made.tokens, Vec::len);
        Ok(zs_reconstruction_info {
            has_tokens: tokens.is_some().into(),
            view_count: made.placement.as_ref().map_or(0, |placement| placement.maps.len()),
            token_count,
            gaussian_count: made.gaussians.len() * token_count / made.tokens,
            warnings: warnings.as_ptr(),
            channel_count: features.as_ref().map_or(0, |features| features.channels()),
            ..Versioned::new()
        })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(reconstruction, "reconstruction", info, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_get_patch_tokens(
    reconstruction: *const zs_reconstruction,
    index: usize,
    tokens: *mut zs_pixel_values,
) -> zs_status {
    let of = |reconstruction: &zs_reconstruction| Ok(element(reconstruction.patch_tokens()?, index)?.into());
    // SAFETY: the caller's arguments.
    unsafe { describe(reconstruction, "reconstruction", tokens, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_to_scene(
    reconstruction: *const zs_reconstruction,
    scene: *mut *mut zs_scene,
) -> zs_status {
    // SAFETY: the caller's arguments.
    let read = || Ok(unsafe { borrow(reconstruction, "reconstruction") }?.scene()?.clone().into());
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, read) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_estimate_camera(
    reconstruction: *const zs_reconstruction,
    index: usize,
    estimate: *mut zs_camera_estimate,
) -> zs_status {
    let of = |reconstruction: &zs_reconstruction| {
        let Estimate(camera, inliers, patches) = element(reconstruction.estimates()?, index)?;
        let camera = camera.as_ref().map_or(null(), |camera| &raw const *camera);
        Ok(zs_camera_estimate { inliers: *inliers, patches: *patches, camera, ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(reconstruction, "reconstruction", estimate, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_destroy(reconstruction: *mut zs_reconstruction) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(reconstruction) }
}
