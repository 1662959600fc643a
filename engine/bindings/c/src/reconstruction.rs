//! Reconstructions.

use super::{
    camera::zs_camera,
    image::zs_pixel_values,
    pointers::{Versioned, borrow, describe, destroy, produce},
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

/// A reconstruction's Gaussians on its device, with their relation to the photos.
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

/// Description of a reconstruction.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_reconstruction_info {
    /// sizeof(zs_reconstruction_info).
    pub struct_size: u32,
    /// 1 if ZS_REFINE_TARGET_TOKENS is possible.
    pub has_tokens: u32,
    /// Number of photos.
    pub view_count: usize,
    /// Number of kept tokens.
    pub token_count: usize,
    /// Number of Gaussians.
    pub gaussian_count: usize,
    /// Warnings.
    pub warnings: *const c_char,
    /// Channels of zs_reconstruction_get_patch_tokens; 0 without features.
    pub channel_count: usize,
}

/// Estimated camera of a photo.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_camera_estimate {
    /// sizeof(zs_camera_estimate).
    pub struct_size: u32,
    /// Number of patches that agree with the camera.
    pub inliers: u32,
    /// Number of patches.
    pub patches: u32,
    /// 0.
    pub reserved: u32,
    /// Camera of the whole photo in the scene's world; NULL without an estimate.
    pub camera: *const zs_camera,
}

versioned!(zs_reconstruction_info, zs_camera_estimate);

impl zs_reconstruction {
    pub(super) fn new(made: Reconstruction, tokens: Option<ModelTokens>, arena: Arena, warnings: String) -> Self {
        let warnings = CString::new(warnings).unwrap_or_default();
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

/// Describes a reconstruction.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_get_info(
    reconstruction: *const zs_reconstruction,
    info: *mut zs_reconstruction_info,
) -> zs_status {
    let of = |zs_reconstruction { made, tokens, features, warnings, .. }: &zs_reconstruction| {
        Ok(zs_reconstruction_info {
            has_tokens: tokens.is_some().into(),
            view_count: made.placement.as_ref().map_or(0, |placement| placement.maps.len()),
            token_count: made.tokens,
            gaussian_count: made.gaussians.len(),
            warnings: warnings.as_ptr(),
            channel_count: features.as_ref().map_or(0, |features| features.channels()),
            ..Versioned::new()
        })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(reconstruction, "reconstruction", info, of) }
}

/// Returns the patch tokens of the backbone's last layer, a cell per patch, for photo `index`: for
/// its center crop with the aspect ratio of the network's input. They belong to the reconstruction.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_get_patch_tokens(
    reconstruction: *const zs_reconstruction,
    index: usize,
    tokens: *mut zs_pixel_values,
) -> zs_status {
    let of = |reconstruction: &zs_reconstruction| {
        let views = reconstruction.patch_tokens()?;
        let expected = || format!("a number below {}", views.len());
        let PixelValues { width, height, values, .. } =
            views.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))?;
        Ok(zs_pixel_values { width: *width, height: *height, values: values.as_ptr(), ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(reconstruction, "reconstruction", tokens, of) }
}

/// Reads the scene from the device.
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

/// Estimates the camera of photo `index` from its patches' Gaussians. The first call estimates all,
/// with one field of view. Fails if no photo has an estimate, or for known cameras.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_estimate_camera(
    reconstruction: *const zs_reconstruction,
    index: usize,
    estimate: *mut zs_camera_estimate,
) -> zs_status {
    let of = |reconstruction: &zs_reconstruction| {
        let estimates = reconstruction.estimates()?;
        let expected = || format!("a number below {}", estimates.len());
        let Estimate(camera, inliers, patches) =
            estimates.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))?;
        let camera = camera.as_ref().map_or(null(), |camera| &raw const *camera);
        Ok(zs_camera_estimate { inliers: *inliers, patches: *patches, camera, ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(reconstruction, "reconstruction", estimate, of) }
}

/// Destroys a reconstruction.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruction_destroy(reconstruction: *mut zs_reconstruction) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(reconstruction) }
}
