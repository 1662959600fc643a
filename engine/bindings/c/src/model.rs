//! Models.

use super::{
    device::zs_device,
    pointers::{
        Versioned, array, borrow, c_text, describe, destroy, flag, optional_text, produce, read_versioned, text,
    },
    progress::{Reporter, zs_progress_callback},
    status::{Failure, zs_status},
};
use std::{
    ffi::{CString, c_char, c_void},
    sync::Arc,
};
use zipsplat::{
    Error, ops::Precision, reconstruct::Model, refine::FrozenHead, tune::KernelChoice, weights::Checkpoint,
};

pub struct zs_model {
    pub(super) model: Model,
    pub(super) head: Option<Arc<FrozenHead>>,
    precision: Precision,
    /// Unavailable GPUs and kernels.
    warnings: CString,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_model_options {
    pub struct_size: u32,
    pub precision: zs_precision_value,
    pub variant: *const c_char,
    pub progress: zs_progress_callback,
    pub user_data: *mut c_void,
    pub tokens: u32,
    pub reserved: u32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_model_info {
    pub struct_size: u32,
    pub image_size: u32,
    pub patch_size: u32,
    pub gaussians_per_token: u32,
    pub sh_degree: u32,
    pub precision: zs_precision_value,
    pub weight_bytes: u64,
    pub warnings: *const c_char,
}

versioned!(zs_model_options { reserved }, zs_model_info);

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_precision {
    ZS_PRECISION_AUTO = 0,
    ZS_PRECISION_FP32 = 1,
    ZS_PRECISION_FP16 = 2,
    ZS_PRECISION_BF16 = 3,
    ZS_PRECISION_INT8 = 4,
}

impl zs_precision {
    pub(super) fn wanted(number: i32) -> Result<Option<Precision>, Failure> {
        if number == Self::ZS_PRECISION_AUTO as i32 {
            return Ok(None);
        }
        let found = Precision::ALL.into_iter().find(|precision| Self::from(*precision) as i32 == number);
        found.map(Some).ok_or_else(|| Failure::argument("precision", number, "a zs_precision"))
    }
}

impl From<Precision> for zs_precision {
    fn from(precision: Precision) -> Self {
        match precision {
            Precision::Fp32 => Self::ZS_PRECISION_FP32,
            Precision::Fp16 => Self::ZS_PRECISION_FP16,
            Precision::Bf16 => Self::ZS_PRECISION_BF16,
            Precision::Int8 => Self::ZS_PRECISION_INT8,
        }
    }
}

pub(super) type zs_precision_value = i32;

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_load(
    device: *const zs_device,
    path: *const c_char,
    options: *const zs_model_options,
    model: *mut *mut zs_model,
) -> zs_status {
    // SAFETY: the caller's arguments.
    let checkpoint = |variant: Option<&str>| match unsafe { text(path, "path") }? {
        "builtin" => match variant {
            Some(variant) => Err(Failure::argument("variant", variant, "NULL: the built-in model names its own")),
            None => builtin(),
        },
        path => Ok(Checkpoint::parse(path, variant)?),
    };
    // SAFETY: the caller's objects.
    unsafe { load(device, options, model, checkpoint) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_from_memory(
    device: *const zs_device,
    data: *const c_void,
    size: usize,
    options: *const zs_model_options,
    model: *mut *mut zs_model,
) -> zs_status {
    let checkpoint = |variant: Option<&str>| {
        // SAFETY: the caller's array of that size.
        let bytes = unsafe { array(data.cast::<u8>(), size, "bytes of a model") }?;
        // SAFETY: `load` drops the checkpoint before this call returns.
        let bytes = unsafe { std::mem::transmute::<&[u8], &'static [u8]>(bytes) };
        Ok(Checkpoint::from_bytes("model in memory", bytes, variant)?)
    };
    // SAFETY: the caller's objects.
    unsafe { load(device, options, model, checkpoint) }
}

fn builtin() -> Result<Checkpoint, Failure> {
    Checkpoint::builtin().map_err(|error| match error {
        Error::Argument { .. } => Failure::unsupported(error.to_string()),
        other => other.into(),
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_get_info(model: *const zs_model, info: *mut zs_model_info) -> zs_status {
    let of = |zs_model { model, precision, warnings, .. }: &zs_model| {
        let architecture = model.architecture();
        Ok(zs_model_info {
            image_size: model.image_size(),
            patch_size: architecture.patch_size as u32,
            gaussians_per_token: architecture.gaussians_per_token as u32,
            sh_degree: architecture.sh_degree as u32,
            precision: zs_precision::from(*precision) as i32,
            weight_bytes: model.weight_bytes(),
            warnings: warnings.as_ptr(),
            ..Versioned::new()
        })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(model, "model", info, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_destroy(model: *mut zs_model) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(model) }
}

/// # Safety
/// `device` and `options` are NULL or valid; `out` is NULL or writable.
unsafe fn load(
    device: *const zs_device,
    options: *const zs_model_options,
    out: *mut *mut zs_model,
    checkpoint: impl FnOnce(Option<&str>) -> Result<Checkpoint, Failure>,
) -> zs_status {
    let load = || {
        // SAFETY: the caller's objects.
        let (device, options) = unsafe { (borrow(device, "device")?, read_versioned(options)?) };
        let chosen = KernelChoice::of(&device.gpu, zs_precision::wanted(options.precision)?)?;
        let has_tokens = flag("tokens", options.tokens)?;
        // SAFETY: the caller's arguments.
        let checkpoint = checkpoint(unsafe { optional_text(options.variant, "variant") }?)?;
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let progress = |fraction| reporter.fraction("weights", fraction);
        let model = Model::from_checkpoint_with(&device.gpu, &checkpoint, chosen.arithmetic, progress)?;
        let head = has_tokens.then(|| FrozenHead::load(&device.gpu, &checkpoint)).transpose()?;
        let warnings = [device.gpu.passed_over(), &chosen.warnings, checkpoint.notes()].concat();
        let warnings = c_text(&warnings.join("\n"));
        Ok(zs_model { model, head: head.map(Arc::new), precision: chosen.precision, warnings })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(out, load) }
}
