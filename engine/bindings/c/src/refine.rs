//! Refinement: optimizes a scene to match photos.

use super::{
    context::zs_context,
    picture::{zs_camera, zs_image},
    pointers::{
        POINTER, Versioned, borrow, flow, produce, read_array, read_versioned, write_defaults, write_versioned,
    },
    scene::{ModelTokens, zs_scene},
    status::{Failure, zs_status},
};
use std::{ffi::c_void, ops::ControlFlow};
use zipsplat::{
    Error,
    gpu::Arena,
    refine::{RefineOptions, RefineResult, Refining, StopReason, refine_scene, refine_tokens},
    types::{Camera, Image, Pose},
};

/// Holds out one photo of 40 or more, else none.
pub const ZS_HOLD_OUT_AUTO: i32 = -1;

/// Optimized parameters.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_refine_what {
    /// The scene's Gaussians.
    ZS_REFINE_GAUSSIANS = 0,
    /// The tokens behind the Gaussians; needs zs_model_options.tokens.
    ZS_REFINE_TOKENS = 1,
}

pub(super) type zs_refine_what_value = i32;

/// Reasons for the end of a refinement.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_refine_end {
    /// All steps completed.
    ZS_REFINE_FINISHED = 0,
    /// The progress callback stopped it.
    ZS_REFINE_STOPPED = 1,
    /// The loss grew, or became NaN or infinite.
    ZS_REFINE_DIVERGED = 2,
}

pub(super) type zs_refine_end_value = i32;

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
    pub seconds_left: f64,
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
    /// Optimizer steps. Default 100.
    pub steps: u32,
    /// Photos per step, at least 1, capped at the number of training photos. Default 4.
    pub views_per_step: u32,
    /// Number of held-out photos, evenly spaced, less than all, or ZS_HOLD_OUT_AUTO. The step with
    /// their best PSNR is returned. Default ZS_HOLD_OUT_AUTO.
    pub hold_out: i32,
    /// Largest compared width in pixels; larger photos are downscaled. 0 keeps full size. Default
    /// 1600.
    pub width: u32,
    /// Largest compared height; 0 exactly if `width` is 0. Default 1600.
    pub height: u32,
    /// Seed of the photo order.
    pub seed: u64,
    /// Progress callback.
    pub progress: zs_refine_progress,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
    /// Optimized parameters.
    pub what: zs_refine_what_value,
    /// Must be 0.
    pub reserved: u32,
}

/// Result of a refinement.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_refine_info {
    /// sizeof(zs_refine_info).
    pub struct_size: u32,
    /// Reason for the end.
    pub ended: zs_refine_end_value,
    /// Completed steps.
    pub steps: u32,
    /// Step of the returned scene; 0 if none improved it.
    pub best_step: u32,
    /// Mean loss of the first step, at its resolution; NaN without a step.
    pub first_loss: f64,
    /// Mean loss of the last step, likewise.
    pub last_loss: f64,
    /// Held-out PSNR in dB before the first step; NaN without held-out photos.
    pub psnr_before: f64,
    /// Held-out PSNR in dB of the returned scene.
    pub psnr: f64,
    /// Duration in seconds.
    pub seconds: f64,
    /// Mean PSNR in dB of up to 16 full-size training photos before the first step.
    pub training_psnr_before: f64,
    /// PSNR in dB of the same photos for the returned scene.
    pub training_psnr: f64,
}

// SAFETY: repr(C), six 4-byte values, a u64, pointers and two 4-byte values: no padding.
unsafe impl Versioned for zs_refine_options {
    const NAME: &str = "zs_refine_options";
    const FIRST_SIZE: usize = 32 + 2 * POINTER;
    fn defaults() -> Self {
        let RefineOptions { steps, views_per_step, seed, .. } = RefineOptions::default();
        Self {
            struct_size: size_of::<Self>() as u32,
            steps: steps as u32,
            views_per_step: views_per_step as u32,
            hold_out: ZS_HOLD_OUT_AUTO,
            width: MOST_PIXELS,
            height: MOST_PIXELS,
            seed,
            progress: None,
            user_data: std::ptr::null_mut(),
            what: zs_refine_what::ZS_REFINE_GAUSSIANS as i32,
            reserved: 0,
        }
    }
}

// SAFETY: repr(C), four values of four bytes and seven f64: no padding.
unsafe impl Versioned for zs_refine_info {
    const NAME: &str = "zs_refine_info";
    const FIRST_SIZE: usize = 56;
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>() as u32,
            ended: zs_refine_end::ZS_REFINE_FINISHED as i32,
            steps: 0,
            best_step: 0,
            first_loss: f64::NAN,
            last_loss: f64::NAN,
            psnr_before: f64::NAN,
            psnr: f64::NAN,
            seconds: 0.0,
            training_psnr_before: f64::NAN,
            training_psnr: f64::NAN,
        }
    }
}

const MOST_PIXELS: u32 = 1600;

/// Sets defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_refine_options_default(options: *mut zs_refine_options, size: usize) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Optimizes a copy of a scene to match `count` photos. `cameras` are of the whole photos, in the
/// scene's world. An early stop or a diverging loss still returns the best scene. `info` may be
/// NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_refine(
    context: *const zs_context,
    scene: *const zs_scene,
    images: *const zs_image,
    cameras: *const zs_camera,
    count: usize,
    options: *const zs_refine_options,
    info: *mut zs_refine_info,
    refined: *mut *mut zs_scene,
) -> zs_status {
    let refine = || {
        // SAFETY: objects or NULL; a structure or NULL; arrays of the caller's.
        let (context, scene, options, images, cameras) = unsafe {
            let (images, cameras) = (read_array(images, count, "images")?, read_array(cameras, count, "cameras")?);
            (borrow(context, "context")?, borrow(scene, "scene")?, read_versioned(options)?, images, cameras)
        };
        if count == 0 {
            return Err(Failure::argument("number of images", count, "at least 1"));
        }
        let request = options.request()?;
        if !info.is_null() {
            // SAFETY: the caller's structure. Checked before expensive work.
            unsafe { write_versioned(info, zs_refine_info::defaults()) }?;
        }
        let cameras: Vec<Camera> = cameras.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
        let photo = |(i, image): (usize, &zs_image)| {
            // SAFETY: the caller's pixels.
            unsafe { image.image(&format!("image {i}")) }
        };
        let photos: Vec<_> = images.iter().enumerate().map(photo).collect::<Result<_, _>>()?;
        let progress = |now: Refining| options.tell(&now);
        let found = if options.what == zs_refine_what::ZS_REFINE_TOKENS as i32 {
            let Some(tokens) = &scene.tokens else {
                let expected = "a scene of zs_reconstruct, with a model that was opened with tokens = 1";
                return Err(Failure::argument("scene", "a scene without tokens", expected));
            };
            tokens.refine(&photos, &cameras, &request, progress)?
        } else {
            refine_scene(&Arena::new(&context.device), &scene.scene, &photos, &cameras, &request, progress)?
        };
        if !info.is_null() {
            // SAFETY: as above.
            unsafe { write_versioned(info, zs_refine_info::of(&found)) }?;
        }
        Ok(found.scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(refined, refine) }
}

impl zs_refine_options {
    fn request(&self) -> Result<RefineOptions, Failure> {
        let size = match (self.width, self.height) {
            (0, 0) => None,
            (0, _) | (_, 0) => {
                let found = format!("{} x {}", self.width, self.height);
                return Err(Failure::argument("width and height", found, "both 0, or both above it"));
            }
            (width, height) => Some([width, height]),
        };
        if self.views_per_step == 0 {
            return Err(Failure::argument("views_per_step", 0, "at least 1"));
        }
        if self.reserved != 0 {
            return Err(Failure::argument("zs_refine_options, reserved", self.reserved, "0"));
        }
        if !(0..=zs_refine_what::ZS_REFINE_TOKENS as i32).contains(&self.what) {
            return Err(Failure::argument("what", self.what, "a zs_refine_what"));
        }
        let hold_out = match self.hold_out {
            ZS_HOLD_OUT_AUTO => None,
            count => Some(
                usize::try_from(count)
                    .map_err(|_| Failure::argument("hold_out", count, "a number of photos, or ZS_HOLD_OUT_AUTO"))?,
            ),
        };
        let (steps, views_per_step) = (self.steps as usize, self.views_per_step as usize);
        Ok(RefineOptions {
            steps,
            views_per_step,
            max_image_size: size,
            holdout_views: hold_out,
            seed: self.seed,
            ..RefineOptions::default()
        })
    }

    fn tell(&self, now: &Refining<'_>) -> ControlFlow<()> {
        let Some(progress) = self.progress else { return ControlFlow::Continue(()) };
        let now = zs_refining {
            struct_size: size_of::<zs_refining>() as u32,
            step: now.step as u32,
            steps: now.steps as u32,
            reserved: 0,
            loss: now.loss.map_or(f64::NAN, f64::from),
            psnr: now.psnr.unwrap_or(f64::NAN),
            seconds_left: now.left.as_secs_f64(),
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
        progress: impl FnMut(Refining) -> ControlFlow<()>,
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

impl zs_refine_info {
    fn of(refined: &RefineResult) -> Self {
        let loss = |loss: Option<&f32>| loss.map_or(f64::NAN, |loss| f64::from(*loss));
        let [psnr, psnr_before] = refined.psnr().unwrap_or([f64::NAN; 2]);
        let ended = match refined.stop_reason {
            None => zs_refine_end::ZS_REFINE_FINISHED,
            Some(StopReason::Cancelled) => zs_refine_end::ZS_REFINE_STOPPED,
            Some(StopReason::Diverged(_)) => zs_refine_end::ZS_REFINE_DIVERGED,
        };
        Self {
            ended: ended as i32,
            steps: refined.losses.len() as u32,
            best_step: refined.best_step as u32,
            first_loss: loss(refined.losses.first()),
            last_loss: loss(refined.losses.last()),
            psnr_before,
            psnr,
            seconds: refined.took.as_secs_f64(),
            training_psnr_before: refined.training_psnr[1],
            training_psnr: refined.training_psnr[0],
            ..Versioned::defaults()
        }
    }
}
