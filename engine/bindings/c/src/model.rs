//! Models.

use super::{
    context::zs_context,
    pointers::{
        POINTER, Versioned, array, borrow, destroy, flow, optional_text, produce, read_versioned, text, write_defaults,
        write_versioned,
    },
    scene::LatestScene,
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{CString, c_char, c_void},
    ops::ControlFlow,
    sync::{Arc, Mutex},
};
use zipsplat::{Error, ops::Precision, reconstruct::Model, refine::FrozenHead, tune::Chosen, weights::Checkpoint};

/// A network with its weights on a context's device. Any number of threads may reconstruct with a model at the same time.
pub struct zs_model {
    pub(super) model: Model,
    /// Side of the pictures it is best with.
    pub(super) picture_side: u32,
    /// The latest scene, which stays on the device for renderers.
    pub(super) latest: LatestScene,
    /// The head by which tokens of its scenes are refined, where they are kept.
    pub(super) head: Option<Arc<FrozenHead>>,
    precision: Precision,
    /// GPUs and kernels that are not used, one a line.
    notes: CString,
}

/// Called now and then while something takes long, on the thread that made the call, with the share that is done (0 to 1) and
/// what is under way (for a log; valid during the call). Return 0 to go on; anything else stops the work, which then ends
/// with ZS_ERROR_CANCELLED. It must return: no longjmp, no C++ exception. It may call zs_ functions, but not with the objects
/// of the call that it came from.
pub type zs_progress = Option<unsafe extern "C" fn(user_data: *mut c_void, fraction: f64, stage: *const c_char) -> i32>;

/// Options of loading a model.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_model_options {
    /// sizeof(zs_model_options); zs_model_options_default sets it.
    pub struct_size: u32,
    /// Number formats. Default ZS_PRECISION_BEST.
    pub precision: zs_precision_value,
    /// The network of a checkpoint that does not say: "vitg", "vits", "vitb", "vitl", "da3s", "da3b" or "da3l", and what else it
    /// leaves open, as in "vits:out_layers=5,7,11:alt_start=5:rope_start=5". NULL takes what the file says.
    /// Default NULL.
    pub variant: *const c_char,
    /// Told how far it is; may stop it. Default NULL.
    pub progress: zs_progress,
    /// Given to `progress`.
    pub user_data: *mut c_void,
    /// 1 to be able to refine the tokens of its scenes with ZS_REFINE_TOKENS: the network's head stays on the device in f32 besides, and
    /// each scene keeps its tokens there until it is destroyed. Default 0.
    pub tokens: u32,
    /// 0.
    pub reserved: u32,
}

/// Facts about a model.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_model_info {
    /// sizeof(zs_model_info); set it before the call.
    pub struct_size: u32,
    /// Side in pixels of the square pictures that it is best with.
    pub picture_side: u32,
    /// Side of a patch in pixels: sizes of pictures are multiples of it.
    pub patch: u32,
    /// Gaussians that a token becomes. At ratio 1 there are width / patch * height / patch tokens a photo.
    pub gaussians_per_token: u32,
    /// Highest band of spherical harmonics of its scenes.
    pub sh_degree: u32,
    /// Number formats in use: a zs_precision other than ZS_PRECISION_BEST.
    pub precision: zs_precision_value,
    /// Bytes of its weights on the device.
    pub weight_bytes: u64,
    /// Reasons why the model may be slow, one a line: GPUs that cannot be used, where a CPU is; kernels that failed the test before their
    /// first use and are not used, and where that leaves too few, ZS_PRECISION_BEST is ZS_PRECISION_EXACT. "" where there is none.
    /// Also what was rounded or assumed to read the weights. The model's own memory, there until it is destroyed.
    pub notes: *const c_char,
}

/// Number formats of the network. Geometry is f32 always.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_precision {
    /// ZS_PRECISION_FAST on a GPU with matrix units whose kernels passed their test, else ZS_PRECISION_EXACT.
    ZS_PRECISION_BEST = 0,
    /// f32 throughout.
    ZS_PRECISION_EXACT = 1,
    /// f16 factors of matrix products, all else f32. Refused where the device cannot, or fails the test.
    ZS_PRECISION_FAST = 2,
    /// bf16 factors of matrix products, all else f32: f32's range in 8 bits. Refused as ZS_PRECISION_FAST.
    ZS_PRECISION_FAST_BF16 = 3,
    /// 8-bit factors in the linear layers of blocks, all else as ZS_PRECISION_FAST.
    ZS_PRECISION_TURBO = 4,
}

impl zs_precision {
    /// The precision that a number asks for; `None` is the device's best.
    pub(super) fn wanted(number: i32) -> Result<Option<Precision>, Failure> {
        if number == Self::ZS_PRECISION_BEST as i32 {
            return Ok(None);
        }
        let found = Precision::ALL.into_iter().find(|precision| Self::from(*precision) as i32 == number);
        found.map(Some).ok_or_else(|| Failure::argument("precision", number, "a zs_precision"))
    }
}

impl From<Precision> for zs_precision {
    fn from(precision: Precision) -> Self {
        match precision {
            Precision::Exact => Self::ZS_PRECISION_EXACT,
            Precision::Fast => Self::ZS_PRECISION_FAST,
            Precision::FastBf16 => Self::ZS_PRECISION_FAST_BF16,
            Precision::Turbo => Self::ZS_PRECISION_TURBO,
        }
    }
}

pub(super) type zs_precision_value = i32;

// SAFETY: repr(C), two pairs of 32 bits and pointers between them: no padding.
unsafe impl Versioned for zs_model_options {
    const NAME: &str = "zs_model_options";
    const FIRST_SIZE: usize = 8 + 3 * POINTER;
    fn defaults() -> Self {
        let (struct_size, user_data) = (size_of::<Self>() as u32, std::ptr::null_mut());
        let precision = zs_precision::ZS_PRECISION_BEST as i32;
        Self { struct_size, precision, variant: std::ptr::null(), progress: None, user_data, tokens: 0, reserved: 0 }
    }
}

// SAFETY: repr(C), six u32, a u64 and a pointer: no padding but at the end, where pointers have 4 bytes.
unsafe impl Versioned for zs_model_info {
    const NAME: &str = "zs_model_info";
    const FIRST_SIZE: usize = 32 + POINTER;
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>() as u32,
            picture_side: 0,
            patch: 0,
            gaussians_per_token: 0,
            sh_degree: 0,
            precision: zs_precision::ZS_PRECISION_EXACT as i32,
            weight_bytes: 0,
            notes: c"".as_ptr(),
        }
    }
}

/// Fills `options` with the defaults. `size` is sizeof(zs_model_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_options_default(options: *mut zs_model_options, size: usize) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Loads a checkpoint onto a context's device: safetensors or a PyTorch archive at `path` (UTF-8), the model that is built
/// into the library for "embedded" (ZS_ERROR_UNSUPPORTED where none is), or random numbers for "seeded:VARIANT", to try things
/// out. `options` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_open(
    context: *const zs_context,
    path: *const c_char,
    options: *const zs_model_options,
    model: *mut *mut zs_model,
) -> zs_status {
    // SAFETY: a string or NULL.
    let checkpoint = |variant: Option<&str>| match unsafe { text(path, "path") }? {
        "embedded" => match variant {
            Some(variant) => Err(Failure::argument("variant", variant, "NULL: the embedded model says what it is")),
            None => embedded(),
        },
        path => Ok(Checkpoint::parse(path, variant)?),
    };
    // SAFETY: the caller's objects.
    unsafe { load(context, options, model, checkpoint) }
}

/// As zs_model_open, with a file's contents, which are not needed any more when this returns.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_from_memory(
    context: *const zs_context,
    data: *const c_void,
    size: usize,
    options: *const zs_model_options,
    model: *mut *mut zs_model,
) -> zs_status {
    let checkpoint = |variant: Option<&str>| {
        // SAFETY: the caller's array of that size.
        let bytes = unsafe { array(data.cast::<u8>(), size, "bytes of a model") }?;
        // SAFETY: a checkpoint is dropped in `load`, before this call returns and the caller may free the bytes.
        let bytes = unsafe { std::mem::transmute::<&[u8], &'static [u8]>(bytes) };
        Ok(Checkpoint::from_bytes("model in memory", bytes, variant)?)
    };
    // SAFETY: the caller's objects.
    unsafe { load(context, options, model, checkpoint) }
}

/// The checkpoint that is built in; where a build has none, that is no mistake of the caller's.
fn embedded() -> Result<Checkpoint, Failure> {
    Checkpoint::embedded().map_err(|error| match error {
        Error::Argument { .. } => Failure::unsupported(error.to_string()),
        other => other.into(),
    })
}

/// Says what a model is.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_get_info(model: *const zs_model, info: *mut zs_model_info) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let zs_model { model, picture_side, precision, notes, .. } = unsafe { borrow(model, "model") }?;
        let architecture = model.architecture();
        let found = zs_model_info {
            picture_side: *picture_side,
            patch: architecture.patch as u32,
            gaussians_per_token: architecture.gaussians_per_token as u32,
            sh_degree: architecture.sh_degree as u32,
            precision: zs_precision::from(*precision) as i32,
            weight_bytes: model.weight_bytes(),
            notes: notes.as_ptr(),
            ..Versioned::defaults()
        };
        // SAFETY: the caller's structure.
        unsafe { write_versioned(info, found) }
    })
}

/// Destroys a model. NULL is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_destroy(model: *mut zs_model) {
    // SAFETY: an object that the caller gives up, or NULL.
    unsafe { destroy(model) }
}

/// Loads what `checkpoint` gives.
///
/// # Safety
/// `context` is NULL or an object, `options` NULL or a structure, `out` NULL or to be written.
unsafe fn load(
    context: *const zs_context,
    options: *const zs_model_options,
    out: *mut *mut zs_model,
    checkpoint: impl FnOnce(Option<&str>) -> Result<Checkpoint, Failure>,
) -> zs_status {
    let load = || {
        // SAFETY: the caller's objects.
        let (context, options) = unsafe { (borrow(context, "context")?, read_versioned(options)?) };
        let chosen = Chosen::of(&context.device, zs_precision::wanted(options.precision)?)?;
        if options.reserved != 0 {
            return Err(Failure::argument("zs_model_options, reserved", options.reserved, "0"));
        }
        if options.tokens > 1 {
            return Err(Failure::argument("tokens", options.tokens, "0 or 1"));
        }
        // SAFETY: a string or NULL.
        let checkpoint = checkpoint(unsafe { optional_text(options.variant, "variant") }?)?;
        let progress = |fraction| report(options.progress, options.user_data, fraction, "weights");
        let model = Model::load_with(&context.device, &checkpoint, chosen.arithmetic, progress)?;
        let head = (options.tokens == 1).then(|| FrozenHead::load(&context.device, &checkpoint)).transpose()?;
        // No NUL is in what kernels and devices are called.
        let notes = [context.device.passed_over(), &chosen.notes, checkpoint.notes()].concat();
        let notes = CString::new(notes.join("\n")).unwrap_or_default();
        Ok(zs_model {
            model,
            picture_side: checkpoint.picture_side(),
            latest: Mutex::default(),
            head: head.map(Arc::new),
            precision: chosen.precision,
            notes,
        })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(out, load) }
}

/// Tells how far a call is.
pub(super) fn report(progress: zs_progress, user_data: *mut c_void, fraction: f64, stage: &str) -> ControlFlow<()> {
    let Some(progress) = progress else { return ControlFlow::Continue(()) };
    let stage = CString::new(stage).unwrap_or_default();
    // SAFETY: the caller's function, with the caller's data.
    flow(unsafe { progress(user_data, fraction, stage.as_ptr()) })
}
