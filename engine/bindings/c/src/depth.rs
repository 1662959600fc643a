//! Depth and cameras of photos.

use super::{
    camera::zs_camera,
    device::zs_device,
    image::zs_image,
    model::{zs_precision, zs_precision_value},
    pointers::{Versioned, borrow, describe, destroy, produce, read_array, read_versioned, text},
    progress::{Reporter, zs_progress_callback},
    reconstruct::check_view_count,
    scene::zs_scene,
    status::{Failure, zs_status},
};
use std::{
    ffi::{CString, c_char, c_void},
    ptr::null,
};
use zipsplat::{
    Camera, DepthMap, DepthModel, DepthOptions, DepthPrediction, Error, Image, Precision, Progress,
    cameras::share_focal_lengths,
    reconstruct::MAX_VIEWS,
    tune::KernelChoice,
    types::{
        bounded_views,
        preprocess::{PixelMap, View},
    },
    weights::DepthCheckpoint,
};

/// A Depth Anything 3 or VGGT network on a device.
pub struct zs_depth_model {
    model: DepthModel,
    precision: Precision,
    warnings: CString,
}

/// Depth and cameras of photos.
pub struct zs_depth_result {
    depths: DepthPrediction,
    images: Vec<Image>,
    /// Cameras of the maps; `None` if unknown.
    cameras: Vec<Option<Camera>>,
    /// Cameras of the maps and of the whole photos, likewise.
    c_cameras: Vec<Option<[zs_camera; 2]>>,
}

/// Source of estimated cameras.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_camera_source {
    /// The camera decoder.
    ZS_CAMERA_SOURCE_DECODER = 0,
    /// The ray maps, principal point included. Inconsistent rays give no camera.
    ZS_CAMERA_SOURCE_RAYS = 1,
}

pub(super) type zs_camera_source_value = i32;

/// Options of zs_depth_model_load.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_model_options {
    /// sizeof(zs_depth_model_options).
    pub struct_size: u32,
    /// Number formats.
    pub precision: zs_precision_value,
    /// Progress callback.
    pub progress: zs_progress_callback,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
}

/// Description of a depth model.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_model_info {
    /// sizeof(zs_depth_model_info).
    pub struct_size: u32,
    /// 1 if it sees all photos at once and estimates cameras.
    pub is_multi_view: u32,
    /// Patch side, which divides the sides of maps.
    pub patch_size: u32,
    /// Number formats in use.
    pub precision: zs_precision_value,
    /// Device memory of the weights.
    pub weight_bytes: u64,
    /// Unusable GPUs and failed kernels.
    pub warnings: *const c_char,
}

/// Options of zs_depth_predict.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_options {
    /// sizeof(zs_depth_options).
    pub struct_size: u32,
    /// Longer side of the network's input, for VGGT its width, 14 to 8192 pixels; 0 is 504, for
    /// VGGT 518. Each side is rounded to a multiple of 14. Photos of different shapes are cropped
    /// to their common center.
    pub input_size: u32,
    /// Source of estimated cameras.
    pub camera_source: zs_camera_source_value,
    /// 1 estimates a focal length per photo, 0 a shared one for photos of equal size
    /// (confidence-weighted median).
    pub per_view_focal: u32,
    /// 0 or the number of photos.
    pub camera_count: usize,
    /// Known cameras of the whole photos, for multi-view networks. They set the depth scale and are
    /// returned unchanged.
    pub cameras: *const zs_camera,
    /// Progress callback.
    pub progress: zs_progress_callback,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
}

/// Description of a depth result.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_result_info {
    /// sizeof(zs_depth_result_info).
    pub struct_size: u32,
    /// 0.
    pub reserved: u32,
    /// Number of photos.
    pub view_count: usize,
}

/// Depth of a photo. Arrays are `[height][width]`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_map {
    /// sizeof(zs_depth_map).
    pub struct_size: u32,
    /// 0.
    pub reserved: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
    /// Distance along the camera's axis, in the cameras' scale, which all views share.
    pub depth: *const f32,
    /// Confidence, at least 1; NULL from single-view networks.
    pub confidence: *const f32,
    /// Sky score, at least 0, above 0.3 for sky; NULL from multi-view networks.
    pub sky: *const f32,
    /// Camera of the map in the common world; NULL if unknown.
    pub camera: *const zs_camera,
    /// Camera of the whole photo; NULL if unknown.
    pub image_camera: *const zs_camera,
}

versioned!(zs_depth_model_options, zs_depth_model_info, zs_depth_options, zs_depth_result_info, zs_depth_map);

/// Loads Depth Anything 3 or VGGT: a released model.safetensors at `path`, or random weights for
/// "seeded:NAME", such as "seeded:da3-small".
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_model_load(
    device: *const zs_device,
    path: *const c_char,
    options: *const zs_depth_model_options,
    model: *mut *mut zs_depth_model,
) -> zs_status {
    let load = || {
        // SAFETY: the caller's objects.
        let (device, path, options) =
            unsafe { (borrow(device, "device")?, text(path, "path")?, read_versioned(options)?) };
        let chosen = KernelChoice::of(&device.gpu, zs_precision::wanted(options.precision)?)?;
        let checkpoint = DepthCheckpoint::whole(|gaussians| DepthCheckpoint::parse(path, gaussians))?;
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let progress = |fraction| reporter.fraction("weights", fraction);
        let model = DepthModel::from_checkpoint(&device.gpu, &checkpoint, chosen.arithmetic, progress)?;
        let warnings = [device.gpu.passed_over(), &chosen.warnings].concat().join("\n");
        let warnings = CString::new(warnings).unwrap_or_default();
        Ok(zs_depth_model { model, precision: chosen.precision, warnings })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(model, load) }
}

/// Describes a depth model.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_model_get_info(
    model: *const zs_depth_model,
    info: *mut zs_depth_model_info,
) -> zs_status {
    let of = |zs_depth_model { model, precision, warnings }: &zs_depth_model| {
        Ok(zs_depth_model_info {
            is_multi_view: model.architecture().multi_view().into(),
            patch_size: model.architecture().backbone.patch_size as u32,
            precision: zs_precision::from(*precision) as i32,
            weight_bytes: model.weight_bytes(),
            warnings: warnings.as_ptr(),
            ..Versioned::new()
        })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(model, "model", info, of) }
}

/// Destroys a depth model.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_model_destroy(model: *mut zs_depth_model) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(model) }
}

/// Estimates depth of 1 to ZS_MAX_VIEWS photos of one place. Multi-view networks also estimate
/// cameras, relative to one of them.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_predict(
    model: *const zs_depth_model,
    images: *const zs_image,
    image_count: usize,
    options: *const zs_depth_options,
    depths: *mut *mut zs_depth_result,
) -> zs_status {
    let find = || {
        // SAFETY: the caller's arguments.
        let (zs_depth_model { model, .. }, options) = unsafe { (borrow(model, "model")?, read_versioned(options)?) };
        check_view_count(image_count, MAX_VIEWS)?;
        let by_rays = options.by_rays()?;
        // SAFETY: the caller's arrays.
        let (images, known) = unsafe {
            (read_array(images, image_count, "images")?, read_array(options.cameras, options.camera_count, "cameras")?)
        };
        if !known.is_empty() && known.len() != images.len() {
            return Err(Failure::argument("number of cameras", known.len(), format!("0 or {image_count}")));
        }
        let known: Vec<Camera> = known.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
        // SAFETY: the caller's pixels.
        let photo = |i: usize| unsafe { images[i].image(&format!("image {i}")) };
        let input_size = Some(options.input_size).filter(|size| *size > 0);
        let views = bounded_views(image_count, photo, model.architecture().fitting(), input_size)?;
        let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
        let known_cameras = (!known.is_empty()).then(|| of_views(&known, &views)).transpose()?;
        let request = DepthOptions { cameras: known_cameras.clone(), ..DepthOptions::default() };
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let progress = |now: Progress<'_>| reporter.fraction(now.scope, now.fraction);
        let mut depths = model.predict(&images, &request, progress)?;
        let cameras = match known_cameras {
            Some(known_cameras) => {
                // Coincident cameras have no scale: depth keeps the network's.
                depths
                    .align_to_cameras(&known_cameras)
                    .or_else(|error| if known_cameras.len() > 1 { Err(error) } else { Ok(()) })?;
                known_cameras.into_iter().map(Some).collect()
            }
            None if !model.architecture().multi_view() => vec![None; images.len()],
            None => found_cameras(&depths, &views, by_rays, options.per_view_focal == 0)?,
        };
        let pair = |(camera, view): (&Option<Camera>, &View)| {
            let camera = camera.as_ref()?;
            let whole = Camera { intrinsics: view.map.undo(&camera.intrinsics), ..*camera };
            Some([camera.into(), (&whole).into()])
        };
        let mut c_cameras: Vec<_> = cameras.iter().zip(&views).map(pair).collect();
        // Known cameras exactly as given.
        c_cameras.iter_mut().flatten().zip(&known).for_each(|([_, whole], known)| *whole = known.into());
        Ok(zs_depth_result { depths, images, cameras, c_cameras })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(depths, find) }
}

/// Describes a depth result.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_get_info(
    depths: *const zs_depth_result,
    info: *mut zs_depth_result_info,
) -> zs_status {
    let of =
        |depths: &zs_depth_result| Ok(zs_depth_result_info { view_count: depths.images.len(), ..Versioned::new() });
    // SAFETY: the caller's arguments.
    unsafe { describe(depths, "depths", info, of) }
}

/// Returns the map of photo `index`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_get_map(
    depths: *const zs_depth_result,
    index: usize,
    map: *mut zs_depth_map,
) -> zs_status {
    let of = |zs_depth_result { depths, c_cameras, .. }: &zs_depth_result| {
        let expected = || format!("a number below {}", depths.views.len());
        let found = depths.views.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))?;
        let values = |values: &Option<Vec<f32>>| values.as_ref().map_or(null(), |values| values.as_ptr());
        let camera = |which: usize| c_cameras[index].as_ref().map_or(null(), |cameras| &raw const cameras[which]);
        let DepthMap { depth, confidence, sky, .. } = found;
        Ok(zs_depth_map {
            width: depths.width,
            height: depths.height,
            depth: depth.as_ptr(),
            confidence: values(confidence),
            sky: values(sky),
            camera: camera(0),
            image_camera: camera(1),
            ..Versioned::new()
        })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(depths, "depths", map, of) }
}

/// Creates a scene with a Gaussian per confident pixel of each posed photo, in the cameras' world.
/// Patches of 14 x 14 pixels keep their `max_gaussians_per_patch` most visible ones; 0 keeps all.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_to_scene(
    depths: *const zs_depth_result,
    max_gaussians_per_patch: u32,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let make = || {
        // SAFETY: the caller's arguments.
        let zs_depth_result { depths, images, cameras, .. } = unsafe { borrow(depths, "depths") }?;
        let posed: Vec<usize> = (0..images.len()).filter(|&i| cameras[i].is_some()).collect();
        if posed.is_empty() {
            let expected = "photos whose cameras were given, or found by a network that sees all photos at once";
            return Err(Failure::argument("cameras of the depths", "none", expected));
        }
        let mut seen = depths.clone();
        seen.keep_views(&cameras.iter().map(Option::is_some).collect::<Vec<_>>());
        let of_views: Vec<Camera> = cameras.iter().flatten().copied().collect();
        let images: Vec<Image> = posed.iter().map(|&i| images[i].clone()).collect();
        Ok(seen
            .scene(&of_views, &images, (max_gaussians_per_patch > 0).then_some(max_gaussians_per_patch as usize))
            .into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, make) }
}

/// Destroys a depth result.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_destroy(depths: *mut zs_depth_result) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(depths) }
}

impl zs_depth_options {
    fn by_rays(&self) -> Result<bool, Failure> {
        if self.per_view_focal > 1 {
            return Err(Failure::argument("per_view_focal", self.per_view_focal, "0 or 1"));
        }
        match self.camera_source {
            0 => Ok(false),
            1 => Ok(true),
            other => Err(Failure::argument("camera_source", other, "a zs_camera_source")),
        }
    }
}

fn of_views(cameras: &[Camera], views: &[View]) -> Result<Vec<Camera>, Error> {
    let of_view = |(i, (camera, view)): (usize, (&Camera, &View))| {
        let label = format!("camera {i}");
        camera.validate(&label)?;
        Ok(Camera { intrinsics: view.map.apply(&camera.intrinsics, &label)?, ..*camera })
    };
    cameras.iter().zip(views).enumerate().map(of_view).collect()
}

fn found_cameras(
    depths: &DepthPrediction,
    views: &[View],
    by_rays: bool,
    shared: bool,
) -> Result<Vec<Option<Camera>>, Error> {
    let found: Vec<Option<Camera>> = if by_rays {
        depths.cameras_of_rays()?.into_iter().map(|found| Some(found.ok()?.camera)).collect()
    } else {
        depths.cameras()?.into_iter().map(Some).collect()
    };
    let posed: Vec<usize> = (0..views.len()).filter(|&i| found[i].is_some()).collect();
    let mut cameras: Vec<Camera> = found.iter().flatten().copied().collect();
    if shared {
        let maps: Vec<PixelMap> = posed.iter().map(|&i| views[i].map).collect();
        // Photos of equal size share a lens.
        let size = |i: &usize| views.iter().position(|view| view.map.from == views[*i].map.from).unwrap_or(*i);
        let weights: Vec<f64> = posed.iter().map(|&i| depths.views[i].mean_confidence()).collect();
        share_focal_lengths(&mut cameras, &maps, &posed.iter().map(size).collect::<Vec<_>>(), &weights);
    }
    let mut all = vec![None; views.len()];
    for (i, camera) in posed.into_iter().zip(cameras) {
        all[i] = Some(camera);
    }
    Ok(all)
}
