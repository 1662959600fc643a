//! Refinement: optimizes a scene to match photos.

use super::{
    camera::zs_camera,
    device::zs_device,
    image::zs_image,
    pointers::{Versioned, borrow, flow, produce, read_array, read_versioned, write_versioned},
    scene::{ModelTokens, zs_scene},
    status::{Failure, zs_status},
};
use std::{ffi::c_void, ops::ControlFlow};
use zipsplat::{
    Error,
    gpu::Arena,
    refine::{RefineOptions, RefineProgress, RefineResult, StopReason, refine_scene, refine_tokens},
    types::{Camera, Image, Pose},
};

/// Holds out no photo.
pub const ZS_HOLDOUT_VIEWS_NONE: i32 = -1;

/// Optimized parameters.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_refine_target {
    /// The scene's Gaussians.
    ZS_REFINE_TARGET_GAUSSIANS = 0,
    /// The tokens behind the Gaussians; needs zs_model_options.tokens.
    ZS_REFINE_TARGET_TOKENS = 1,
}

pub(super) type zs_refine_target_value = i32;

/// Reasons for the end of a refinement.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_stop_reason {
    /// All steps completed.
    ZS_STOP_REASON_FINISHED = 0,
    /// The progress callback stopped it.
    ZS_STOP_REASON_STOPPED = 1,
    /// The loss grew, or became NaN or infinite.
    ZS_STOP_REASON_DIVERGED = 2,
}

pub(super) type zs_stop_reason_value = i32;

/// Progress of a refinement.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_refining {
    /// Size of this structure in the library's version.
    pub struct_size: u32,
    /// Completed steps.
    pub step: u32,
    /// Total steps.
    pub steps: u32,
    /// 0.
    pub reserved: u32,
    /// Mean loss of the last step.
    pub loss: f64,
    /// Latest PSNR in dB of the held-out photos; NaN without any.
    pub psnr: f64,
    /// Estimated seconds left.
    pub eta_seconds: f64,
}

/// Callback after each step. `now` is valid during the callback. Return 0 to continue; any other
/// value ends the refinement early and keeps the best scene. It may call zs_ functions.
pub type zs_refine_progress = Option<unsafe extern "C" fn(user_data: *mut c_void, now: *const zs_refining) -> i32>;

/// Options of zs_refine.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_refine_options {
    /// sizeof(zs_refine_options).
    pub struct_size: u32,
    /// Optimizer steps; 0 is 100.
    pub steps: u32,
    /// Photos per step, capped at the number of training photos; 0 is 4.
    pub views_per_step: u32,
    /// Number of held-out photos, evenly spaced, less than all, or ZS_HOLDOUT_VIEWS_NONE. 0 holds out
    /// one photo of 40 or more. The step with their best PSNR is returned.
    pub holdout_views: i32,
    /// Largest compared width and height in pixels; larger photos are downscaled. 0 is 1600,
    /// UINT32_MAX keeps full size.
    pub max_image_size: [u32; 2],
    /// Seed of the photo order.
    pub seed: u64,
    /// Progress callback.
    pub progress: zs_refine_progress,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
    /// Optimized parameters.
    pub target: zs_refine_target_value,
    /// Must be 0.
    pub reserved: u32,
}

/// Result of a refinement.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_refine_result {
    /// sizeof(zs_refine_result).
    pub struct_size: u32,
    /// Reason for the end.
    pub stop_reason: zs_stop_reason_value,
    /// Completed steps.
    pub steps: u32,
    /// Step of the returned scene; 0 if none improved it.
    pub best_step: u32,
    /// Mean loss of the first step, at its resolution; NaN without a step.
    pub initial_loss: f64,
    /// Mean loss of the last step, likewise.
    pub final_loss: f64,
    /// Held-out PSNR in dB before the first step; NaN without held-out photos.
    pub initial_psnr: f64,
    /// Held-out PSNR in dB of the returned scene.
    pub best_psnr: f64,
    /// Duration in seconds.
    pub seconds: f64,
    /// Mean PSNR in dB of up to 16 full-size training photos before the first step.
    pub initial_training_psnr: f64,
    /// PSNR in dB of the same photos for the returned scene.
    pub best_training_psnr: f64,
}

versioned!(zs_refine_options, zs_refine_result);

/// Optimizes a copy of a scene to match `count` photos. `cameras` are of the whole photos, in the
/// scene's world. An early stop or a diverging loss still returns the best scene. `info` may be
/// NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_refine(
    device: *const zs_device,
    scene: *const zs_scene,
    images: *const zs_image,
    cameras: *const zs_camera,
    count: usize,
    options: *const zs_refine_options,
    info: *mut zs_refine_result,
    refined: *mut *mut zs_scene,
) -> zs_status {
    let refine = || {
        // SAFETY: objects or NULL; a structure or NULL; arrays of the caller's.
        let (device, scene, options, images, cameras) = unsafe {
            let (images, cameras) = (read_array(images, count, "images")?, read_array(cameras, count, "cameras")?);
            (borrow(device, "device")?, borrow(scene, "scene")?, read_versioned(options)?, images, cameras)
        };
        if count == 0 {
            return Err(Failure::argument("number of images", count, "at least 1"));
        }
        let request = options.request()?;
        if !info.is_null() {
            // SAFETY: the caller's structure. Checked before expensive work.
            unsafe { write_versioned(info, zs_refine_result::new()) }?;
        }
        let cameras: Vec<Camera> = cameras.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
        let photo = |(i, image): (usize, &zs_image)| {
            // SAFETY: the caller's pixels.
            unsafe { image.image(&format!("image {i}")) }
        };
        let photos: Vec<_> = images.iter().enumerate().map(photo).collect::<Result<_, _>>()?;
        let progress = |now: RefineProgress| options.tell(&now);
        let found = if options.target == zs_refine_target::ZS_REFINE_TARGET_TOKENS as i32 {
            let Some(tokens) = &scene.tokens else {
                let expected = "a scene of zs_reconstruct, with a model that was opened with tokens = 1";
                return Err(Failure::argument("scene", "a scene without tokens", expected));
            };
            tokens.refine(&photos, &cameras, &request, progress)?
        } else {
            refine_scene(&Arena::new(&device.gpu), &scene.scene, &photos, &cameras, &request, progress)?
        };
        if !info.is_null() {
            // SAFETY: as above.
            unsafe { write_versioned(info, zs_refine_result::of(&found)) }?;
        }
        Ok(found.scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(refined, refine) }
}

impl zs_refine_options {
    fn request(&self) -> Result<RefineOptions, Failure> {
        let default = RefineOptions::default();
        let or = |number: u32, default: usize| if number == 0 { default } else { number as usize };
        if self.reserved != 0 {
            return Err(Failure::argument("zs_refine_options, reserved", self.reserved, "0"));
        }
        if !(0..=zs_refine_target::ZS_REFINE_TARGET_TOKENS as i32).contains(&self.target) {
            return Err(Failure::argument("target", self.target, "a zs_refine_target"));
        }
        let holdout_views = match self.holdout_views {
            0 => None,
            ZS_HOLDOUT_VIEWS_NONE => Some(0),
            count => Some(usize::try_from(count).map_err(|_| {
                Failure::argument("holdout_views", count, "0, a number of photos, or ZS_HOLDOUT_VIEWS_NONE")
            })?),
        };
        Ok(RefineOptions {
            steps: or(self.steps, default.steps),
            views_per_step: or(self.views_per_step, default.views_per_step),
            max_image_size: Some(self.max_image_size.map(|side| if side == 0 { 1600 } else { side })),
            holdout_views,
            seed: self.seed,
            ..default
        })
    }

    fn tell(&self, now: &RefineProgress<'_>) -> ControlFlow<()> {
        let Some(progress) = self.progress else { return ControlFlow::Continue(()) };
        let now = zs_refining {
            struct_size: size_of::<zs_refining>() as u32,
            step: now.step as u32,
            steps: now.steps as u32,
            reserved: 0,
            loss: now.loss.map_or(f64::NAN, f64::from),
            psnr: now.psnr.unwrap_or(f64::NAN),
            eta_seconds: now.eta.as_secs_f64(),
        };
        // SAFETY: the caller's function, with the caller's data.
        flow(unsafe { progress(self.user_data, &now) })
    }
}

impl ModelTokens {
    fn refine(
        &self,
        photos: &[Image],
        cameras: &[Camera],
        request: &RefineOptions,
        progress: impl FnMut(RefineProgress) -> ControlFlow<()>,
    ) -> Result<RefineResult, Error> {
        // Tokens are in the first camera's space.
        let world = self.pose.unwrap_or(Pose::IDENTITY);
        let camera = |camera: &Camera| Camera { pose: camera.pose.relative_to(&world), ..*camera };
        let cameras: Vec<Camera> = cameras.iter().map(camera).collect();
        let mut refined = refine_tokens(&self.arena, &self.head, &self.tokens, photos, &cameras, request, progress)?;
        self.pose.iter().for_each(|pose| refined.scene.place(1.0, pose));
        Ok(refined)
    }
}

impl zs_refine_result {
    fn of(refined: &RefineResult) -> Self {
        let loss = |loss: Option<&f32>| loss.map_or(f64::NAN, |loss| f64::from(*loss));
        let [best_psnr, initial_psnr] = refined.psnr().unwrap_or([f64::NAN; 2]);
        let stop_reason = match refined.stop_reason {
            None => zs_stop_reason::ZS_STOP_REASON_FINISHED,
            Some(StopReason::Cancelled) => zs_stop_reason::ZS_STOP_REASON_STOPPED,
            Some(StopReason::Diverged(_)) => zs_stop_reason::ZS_STOP_REASON_DIVERGED,
        };
        Self {
            stop_reason: stop_reason as i32,
            steps: refined.losses.len() as u32,
            best_step: refined.best_step as u32,
            initial_loss: loss(refined.losses.first()),
            final_loss: loss(refined.losses.last()),
            initial_psnr,
            best_psnr,
            seconds: refined.took.as_secs_f64(),
            initial_training_psnr: refined.training_psnr[1],
            best_training_psnr: refined.training_psnr[0],
            ..Versioned::new()
        }
    }
}
