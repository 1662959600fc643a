//! Refinement of a scene to match photos.

mod inputs;

use super::{
    camera::zs_camera,
    device::zs_device,
    image::zs_image,
    pointers::{Versioned, borrow, flag, meaning, produce},
    progress::zs_progress_callback,
    reconstruction::{ModelTokens, zs_reconstruction},
    scene::zs_scene,
    status::{Failure, zs_status},
};
use inputs::{Inputs, Photographs, ProgressFunction};
use std::{
    ffi::{c_char, c_void},
    time::Duration,
};
use zipsplat::{
    Camera, Error, Pose, RefineLength, RefineOptions, RefineResult,
    gpu::Arena,
    refine::{DepthKind, DepthLoss, Exposure, PerceptualLoss, StopReason, refine_scene, refine_tokens},
    stages::lpips::LpipsNetwork,
};

pub const ZS_HOLDOUT_VIEWS_NONE: i32 = -1;

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_refine_target {
    ZS_REFINE_TARGET_GAUSSIANS = 0,
    ZS_REFINE_TARGET_TOKENS = 1,
}

pub(super) type zs_refine_target_value = i32;

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_exposure_mode {
    ZS_EXPOSURE_AUTO = 0,
    ZS_EXPOSURE_OFF = 1,
    ZS_EXPOSURE_ON = 2,
}

pub(super) type zs_exposure_mode_value = i32;

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_antialiasing {
    ZS_ANTIALIASING_AUTO = 0,
    ZS_ANTIALIASING_ON = 1,
    ZS_ANTIALIASING_OFF = 2,
}

pub(super) type zs_antialiasing_value = i32;

impl zs_antialiasing {
    /// `None` for the scene's.
    pub(super) fn of(value: zs_antialiasing_value) -> Result<Option<bool>, Error> {
        meaning("antialiasing", value, "zs_antialiasing", [None, Some(true), Some(false)])
    }
}

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_depth_loss {
    ZS_DEPTH_LOSS_OFF = 0,
    ZS_DEPTH_LOSS_METRIC = 1,
    ZS_DEPTH_LOSS_RELATIVE = 2,
}

pub(super) type zs_depth_loss_value = i32;

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_stop_reason {
    ZS_STOP_REASON_FINISHED = 0,
    ZS_STOP_REASON_STOPPED = 1,
    ZS_STOP_REASON_DIVERGED = 2,
    ZS_STOP_REASON_UNSAVED = 3,
}

pub(super) type zs_stop_reason_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_refine_options {
    pub struct_size: u32,
    pub steps: u32,
    pub views_per_step: u32,
    pub holdout_views: i32,
    pub max_image_size: [u32; 2],
    pub target: zs_refine_target_value,
    pub optimize_cameras: u32,
    pub perceptual_weight: f32,
    pub exposure: zs_exposure_mode_value,
    pub seed: u64,
    pub max_gaussians: usize,
    pub progress: zs_progress_callback,
    pub user_data: *mut c_void,
    pub seconds: f64,
    pub antialiasing: zs_antialiasing_value,
    pub depth_loss: zs_depth_loss_value,
    pub depth_weight: f32,
    pub reserved: u32,
    pub checkpoint: *const c_char,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_refine_result {
    pub struct_size: u32,
    pub stop_reason: zs_stop_reason_value,
    pub steps: u32,
    pub best_step: u32,
    pub initial_loss: f64,
    pub final_loss: f64,
    pub initial_psnr: f64,
    pub best_psnr: f64,
    pub seconds: f64,
    pub initial_training_psnr: f64,
    pub best_training_psnr: f64,
    pub cameras: *mut zs_camera,
    pub exposures: *mut f32,
}

versioned!(zs_refine_options { reserved }, zs_refine_result);

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_refine_scene(
    device: *const zs_device,
    scene: *const zs_scene,
    images: *const zs_image,
    cameras: *const zs_camera,
    count: usize,
    options: *const zs_refine_options,
    result: *mut zs_refine_result,
    refined: *mut *mut zs_scene,
) -> zs_status {
    let refine = || {
        // SAFETY: the caller's arguments.
        let (device, scene, inputs) = unsafe {
            let (device, scene) = (borrow(device, "device")?, borrow(scene, "scene")?);
            (device, scene, Inputs::read(images, cameras, count, options, result)?)
        };
        if inputs.refines_tokens {
            let expected = "ZS_REFINE_TARGET_GAUSSIANS: zs_refine_reconstruction refines tokens";
            return Err(Failure::argument("target of a scene", "tokens", expected));
        }
        let arena = Arena::new(&device.gpu);
        let found = inputs.run(|photos, cameras, options, progress| {
            refine_scene(&arena, &scene.scene, photos, cameras, options, progress)
        })?;
        // SAFETY: the caller's structure and array.
        unsafe { inputs.write(result, &found) }?;
        Ok(zs_scene { world: scene.world.clone(), ..found.scene.into() })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(refined, refine) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_refine_reconstruction(
    reconstruction: *const zs_reconstruction,
    images: *const zs_image,
    cameras: *const zs_camera,
    count: usize,
    options: *const zs_refine_options,
    result: *mut zs_refine_result,
    refined: *mut *mut zs_scene,
) -> zs_status {
    let refine = || {
        // SAFETY: the caller's arguments.
        let (reconstruction, inputs) = unsafe {
            let reconstruction = borrow(reconstruction, "reconstruction")?;
            (reconstruction, Inputs::read(images, cameras, count, options, result)?)
        };
        let zs_reconstruction { made, tokens, arena, .. } = reconstruction;
        let found = if inputs.refines_tokens {
            let Some(tokens) = tokens else {
                let expected = "one of a model that was loaded with tokens = 1";
                return Err(Failure::argument("reconstruction", "one without tokens", expected));
            };
            let world = made.placement.as_ref().and_then(|placement| placement.pose);
            inputs.run(|photos, cameras, options, progress| {
                tokens.refine(arena, world, photos, cameras, options, progress)
            })
        } else {
            let scene = reconstruction.scene()?;
            inputs.run(|photos, cameras, options, progress| {
                refine_scene(arena, scene, photos, cameras, options, progress)
            })
        }?;
        // SAFETY: the caller's structure and array.
        unsafe { inputs.write(result, &found) }?;
        Ok(found.scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(refined, refine) }
}

impl zs_refine_options {
    fn engine(&self) -> Result<RefineOptions, Failure> {
        let default = RefineOptions::default();
        let or = |number: u32, default: u32| if number == 0 { default } else { number };
        if !(self.perceptual_weight.is_finite() && self.perceptual_weight >= 0.0) {
            return Err(Failure::argument("perceptual_weight", self.perceptual_weight, "0 or a positive number"));
        }
        let modes = [Exposure::Auto, Exposure::Off, Exposure::On];
        let depth_kinds = [None, Some(DepthKind::Metric), Some(DepthKind::Relative)];
        let depth_loss = meaning("depth_loss", self.depth_loss, "zs_depth_loss", depth_kinds)?.map(DepthLoss::of);
        if !(self.depth_weight.is_finite() && self.depth_weight >= 0.0) {
            return Err(Failure::argument("depth_weight", self.depth_weight, "0 or a positive number"));
        }
        let weight = |default: f32| if self.depth_weight > 0.0 { self.depth_weight } else { default };
        let seconds = Duration::try_from_secs_f64(self.seconds)
            .map_err(|_| Failure::argument("seconds", self.seconds, "0 or a positive time"))?;
        let holdout_views = match self.holdout_views {
            0 => None,
            ZS_HOLDOUT_VIEWS_NONE => Some(0),
            count => Some(usize::try_from(count).map_err(|_| {
                Failure::argument("holdout_views", count, "0, a number of photos, or ZS_HOLDOUT_VIEWS_NONE")
            })?),
        };
        Ok(RefineOptions {
            length: match (self.steps, seconds) {
                (0, Duration::ZERO) => default.length,
                (steps, Duration::ZERO) => RefineLength::Steps(steps as usize),
                (_, seconds) => RefineLength::Time(seconds),
            },
            views_per_step: or(self.views_per_step, default.views_per_step as u32) as usize,
            max_image_size: default.max_image_size.map(|sides| [0, 1].map(|i| or(self.max_image_size[i], sides[i]))),
            holdout_views,
            optimize_cameras: flag("optimize_cameras", self.optimize_cameras)?,
            exposure: meaning("exposure", self.exposure, "zs_exposure_mode", modes)?,
            max_gaussians: (self.max_gaussians > 0).then_some(self.max_gaussians),
            perceptual_loss: (self.perceptual_weight > 0.0)
                .then_some(PerceptualLoss { weight: self.perceptual_weight, network: LpipsNetwork::Vgg }),
            depth_loss: depth_loss.map(|loss| DepthLoss { weight: weight(loss.weight), ..loss }),
            antialiased: zs_antialiasing::of(self.antialiasing)?,
            seed: self.seed,
            ..default
        })
    }
}

impl ModelTokens {
    /// Refines in the first camera's space, where tokens are; `world` is its pose.
    fn refine(
        &self,
        arena: &Arena,
        world: Option<Pose>,
        photos: &Photographs,
        cameras: &[Camera],
        options: &RefineOptions,
        progress: ProgressFunction<'_>,
    ) -> Result<RefineResult, Error> {
        let pose = world.unwrap_or(Pose::IDENTITY);
        let cameras: Vec<Camera> = cameras.iter().map(|camera| camera.relative_to(&pose)).collect();
        let mut refined = refine_tokens(arena, &self.head, &self.tokens, photos, &cameras, options, progress)?;
        if let Some(pose) = world {
            refined.scene.place(1.0, &pose);
            refined.cameras.iter_mut().for_each(|camera| camera.pose = pose.compose(&camera.pose));
        }
        Ok(refined)
    }
}

impl From<&RefineResult> for zs_refine_result {
    fn from(refined: &RefineResult) -> Self {
        let loss = |loss: Option<&f32>| loss.map_or(f64::NAN, |loss| f64::from(*loss));
        let [best_psnr, initial_psnr] = refined.psnr().unwrap_or([f64::NAN; 2]);
        let stop_reason = match refined.stop_reason {
            None => zs_stop_reason::ZS_STOP_REASON_FINISHED,
            Some(StopReason::Cancelled) => zs_stop_reason::ZS_STOP_REASON_STOPPED,
            Some(StopReason::Diverged(_)) => zs_stop_reason::ZS_STOP_REASON_DIVERGED,
            // Photos in memory are always readable.
            Some(StopReason::Failed(_)) => zs_stop_reason::ZS_STOP_REASON_UNSAVED,
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
