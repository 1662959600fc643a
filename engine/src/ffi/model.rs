//! Models, and reconstruction.

use super::{
    context::zs_context,
    picture::{zs_camera, zs_image},
    pointers::{
        POINTER, Versioned, array, borrow, destroy, flow, optional_text, produce, read_versioned, text, write_defaults,
        write_versioned,
    },
    scene::zs_scene,
    status::{Failure, guard, zs_status},
};
use crate::{
    Error,
    gpu::Progress,
    ops::{Chosen, Precision},
    reconstruct::{MAX_VIEWS, Model, Ratio, Request, Selection, Shape},
    types::{
        Camera,
        preprocess::{fit, view_cameras},
    },
    weights::Checkpoint,
};
use std::{
    ffi::{CString, c_char, c_void},
    ops::ControlFlow,
};

/// A network with its weights on a context's device. Any number of threads may reconstruct with a model at the same time.
pub struct zs_model {
    model: Model,
    /// Side of the pictures it is best with.
    picture_side: u32,
    precision: Precision,
}

/// Called now and then while something takes long, on the thread that made the call, with the share that is done (0 to 1) and
/// what is under way (for a log; valid during the call). Return 0 to go on; anything else stops the work, which then ends
/// with ZS_ERROR_CANCELLED. It must return: no longjmp, no C++ exception. It may call zs_ functions, but not with the objects
/// of the call that it came from.
pub type zs_progress = Option<unsafe extern "C" fn(user_data: *mut c_void, fraction: f64, stage: *const c_char) -> i32>;

/// How to load a model.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_model_options {
    /// sizeof(zs_model_options); zs_model_options_default sets it.
    pub struct_size: u32,
    /// Number formats. Default ZS_PRECISION_BEST.
    pub precision: zs_precision_value,
    /// The network of a checkpoint that does not say: "vits", "vitb", "vitl" or "vitg". NULL takes what the file says.
    /// Default NULL.
    pub variant: *const c_char,
    /// Told how far it is; may stop it. Default NULL.
    pub progress: zs_progress,
    /// Given to `progress`.
    pub user_data: *mut c_void,
}

/// What a model is.
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
    /// As ZS_PRECISION_FAST, with 8-bit factors in the linear layers of blocks, where matrix units multiply those.
    ZS_PRECISION_TURBO = 4,
}

/// Which tokens are kept where the ratio is below 1.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_selection {
    /// The nearest token of each centroid of k-means: the method's own.
    ZS_SELECT_KMEANS = 0,
    /// Evenly spread.
    ZS_SELECT_STRIDE = 1,
    /// Random, by `seed`.
    ZS_SELECT_RANDOM = 2,
}

pub(super) type zs_precision_value = i32;
pub(super) type zs_selection_value = i32;

/// Share of the tokens that the paper keeps: 0.5 sqrt(2 / number of photos).
pub const ZS_RATIO_AUTO: f64 = 0.0;

/// What to reconstruct.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_reconstruct_options {
    /// sizeof(zs_reconstruct_options); zs_reconstruct_options_default sets it.
    pub struct_size: u32,
    /// Must be 0.
    pub reserved: u32,
    /// Share of the tokens that become Gaussians, above 0 and up to 1, or ZS_RATIO_AUTO. Fewer are faster and smaller.
    /// Default 1.
    pub ratio: f64,
    /// Which tokens are kept. Default ZS_SELECT_KMEANS.
    pub selection: zs_selection_value,
    /// Width of what the network sees of each photo, a multiple of the model's patch: photos are cropped around their centre
    /// to this shape and scaled to it. 0 for the model's own. Default 0.
    pub width: u32,
    /// Height of it; 0 together with `width`. Default 0.
    pub height: u32,
    /// Number of `cameras`: 0, or one for each photo. Default 0.
    pub camera_count: u32,
    /// For ZS_SELECT_RANDOM: the same seed, the same choice. Default 0.
    pub seed: u64,
    /// Cameras of the whole photos as you pass them, where they are known; their world becomes that of the first. Their unit
    /// is kept; best is one near the median distance of what the first photo sees. Default NULL.
    pub cameras: *const zs_camera,
    /// Told how far it is; may stop it. Default NULL.
    pub progress: zs_progress,
    /// Given to `progress`.
    pub user_data: *mut c_void,
}

// SAFETY: repr(C), two u32 and pointers: no padding.
unsafe impl Versioned for zs_model_options {
    const NAME: &str = "zs_model_options";
    const FIRST_SIZE: usize = 8 + 3 * POINTER;
    fn defaults() -> Self {
        let (struct_size, user_data) = (size_of::<Self>() as u32, std::ptr::null_mut());
        let precision = zs_precision::ZS_PRECISION_BEST as i32;
        Self { struct_size, precision, variant: std::ptr::null(), progress: None, user_data }
    }
}

// SAFETY: repr(C), six u32 and a u64: no padding.
unsafe impl Versioned for zs_model_info {
    const NAME: &str = "zs_model_info";
    const FIRST_SIZE: usize = 32;
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>() as u32,
            picture_side: 0,
            patch: 0,
            gaussians_per_token: 0,
            sh_degree: 0,
            precision: zs_precision::ZS_PRECISION_EXACT as i32,
            weight_bytes: 0,
        }
    }
}

// SAFETY: repr(C), pairs of u32, an f64, a u64 and pointers: no padding.
unsafe impl Versioned for zs_reconstruct_options {
    const NAME: &str = "zs_reconstruct_options";
    const FIRST_SIZE: usize = 40 + 3 * POINTER;
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>() as u32,
            reserved: 0,
            ratio: 1.0,
            selection: zs_selection::ZS_SELECT_KMEANS as i32,
            width: 0,
            height: 0,
            camera_count: 0,
            seed: 0,
            cameras: std::ptr::null(),
            progress: None,
            user_data: std::ptr::null_mut(),
        }
    }
}

/// Fills `options` with the defaults. `size` is sizeof(zs_model_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_options_default(options: *mut zs_model_options, size: usize) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Loads a checkpoint onto a context's device: safetensors or a PyTorch archive at `path` (UTF-8), or random numbers for
/// "seeded:VARIANT", to try things out. `options` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_open(
    context: *const zs_context,
    path: *const c_char,
    options: *const zs_model_options,
    model: *mut *mut zs_model,
) -> zs_status {
    // SAFETY: a string or NULL.
    let checkpoint = |variant: Option<&str>| Ok(Checkpoint::parse(unsafe { text(path, "path") }?, variant)?);
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

/// As zs_model_open, with the model that is built into the library. ZS_ERROR_UNSUPPORTED where none is.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_model_embedded(
    context: *const zs_context,
    options: *const zs_model_options,
    model: *mut *mut zs_model,
) -> zs_status {
    // SAFETY: the caller's objects.
    unsafe { load(context, options, model, |_| embedded()) }
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
        let zs_model { model, picture_side, precision } = unsafe { borrow(model, "model") }?;
        let architecture = model.architecture();
        let found = zs_model_info {
            picture_side: *picture_side,
            patch: architecture.patch as u32,
            gaussians_per_token: architecture.gaussians_per_token as u32,
            sh_degree: architecture.sh_degree as u32,
            precision: match precision {
                Precision::Exact => zs_precision::ZS_PRECISION_EXACT as i32,
                Precision::Fast => zs_precision::ZS_PRECISION_FAST as i32,
                Precision::FastBf16 => zs_precision::ZS_PRECISION_FAST_BF16 as i32,
                Precision::Turbo => zs_precision::ZS_PRECISION_TURBO as i32,
            },
            weight_bytes: model.weight_bytes(),
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

/// Fills `options` with the defaults. `size` is sizeof(zs_reconstruct_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_reconstruct_options_default(
    options: *mut zs_reconstruct_options,
    size: usize,
) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Reconstructs a scene from 1 to 192 photos of one place. It returns when the scene is there. The world is the first photo's
/// camera. `options` may be NULL.
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
        let (zs_model { model, picture_side, .. }, options) =
            unsafe { (borrow(model, "model")?, read_versioned(options)?) };
        if !(1..=MAX_VIEWS).contains(&image_count) {
            return Err(Failure::argument("number of images", image_count, format!("1 to {MAX_VIEWS}")));
        }
        // SAFETY: the caller's arrays.
        let (images, cameras) = unsafe {
            (array(images, image_count, "images")?, array(options.cameras, options.camera_count as usize, "cameras")?)
        };
        let (ratio, selection) = (options.ratio()?, options.selection()?);
        let [width, height] = match (options.width, options.height) {
            (0, 0) => [*picture_side; 2],
            (width, height) => [width, height],
        };
        // Whatever can be refused is refused before pixels are touched.
        Shape::new(model.architecture(), image_count, [width, height], (ratio, &selection), !cameras.is_empty())?;
        if !cameras.is_empty() && cameras.len() != images.len() {
            return Err(Failure::argument("number of cameras", cameras.len(), format!("0 or {image_count}")));
        }
        let mut views = Vec::with_capacity(image_count);
        for (i, image) in images.iter().enumerate() {
            // SAFETY: the caller's pixels.
            views.push(fit(&unsafe { image.image(&format!("image {i}")) }?, width, height)?);
        }
        let cameras: Vec<Camera> = cameras.iter().map(zs_camera::camera).collect();
        let cameras = (!cameras.is_empty()).then(|| view_cameras(&cameras, &views)).transpose()?;
        let images: Vec<_> = views.into_iter().map(|view| view.image).collect();
        let request = Request { ratio, selection, cameras };
        let progress = |now: Progress<'_>| report(options.progress, options.user_data, now.fraction, now.scope);
        Ok(zs_scene { scene: model.reconstruct(&images, &request, progress)?.scene })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, reconstruct) }
}

impl zs_reconstruct_options {
    fn ratio(&self) -> Result<Ratio, Failure> {
        if self.reserved != 0 {
            return Err(Failure::argument("zs_reconstruct_options, reserved", self.reserved, "0"));
        }
        Ok(if self.ratio == ZS_RATIO_AUTO { Ratio::Auto } else { Ratio::Fixed(self.ratio) })
    }

    fn selection(&self) -> Result<Selection, Failure> {
        match self.selection {
            0 => Ok(Selection::KMEANS),
            1 => Ok(Selection::Stride),
            2 => Ok(Selection::Random(self.seed)),
            other => Err(Failure::argument("selection", other, "a zs_selection")),
        }
    }
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
        let precision = match options.precision {
            0 => None,
            1 => Some(Precision::Exact),
            2 => Some(Precision::Fast),
            3 => Some(Precision::FastBf16),
            4 => Some(Precision::Turbo),
            other => return Err(Failure::argument("precision", other, "a zs_precision")),
        };
        let chosen = Chosen::of(&context.device, precision)?;
        // SAFETY: a string or NULL.
        let checkpoint = checkpoint(unsafe { optional_text(options.variant, "variant") }?)?;
        let progress = |fraction| report(options.progress, options.user_data, fraction, "weights");
        let model = Model::load_with(&context.device, &checkpoint, chosen.arithmetic, progress)?;
        Ok(zs_model { model, picture_side: checkpoint.picture_side(), precision: chosen.precision })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(out, load) }
}

fn report(progress: zs_progress, user_data: *mut c_void, fraction: f64, stage: &str) -> ControlFlow<()> {
    let Some(progress) = progress else { return ControlFlow::Continue(()) };
    let stage = CString::new(stage).unwrap_or_default();
    // SAFETY: the caller's function, with the caller's data.
    flow(unsafe { progress(user_data, fraction, stage.as_ptr()) })
}
