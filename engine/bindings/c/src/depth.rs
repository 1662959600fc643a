//! Depth and cameras of photos.

use super::{
    camera::zs_camera,
    device::zs_device,
    image::{zs_image, zs_pixel_values},
    model::{zs_precision, zs_precision_value},
    pointers::{
        Versioned, borrow, c_text, describe, destroy, element, flag, meaning, produce, read_array, read_versioned, text,
    },
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
    Camera, DepthMap, DepthModel, DepthOptions, DepthPrediction, Image, Precision, Progress,
    depth::CameraSource,
    reconstruct::MAX_VIEWS,
    tune::KernelChoice,
    types::{
        bounded_views,
        preprocess::{PixelMap, View},
    },
    weights::DepthCheckpoint,
};

pub struct zs_depth_model {
    model: DepthModel,
    precision: Precision,
    warnings: CString,
}

pub struct zs_depth_result {
    depths: DepthPrediction,
    images: Vec<Image>,
    /// Cameras of the maps; `None` if unknown.
    cameras: Vec<Option<Camera>>,
    /// Cameras of the maps and of the whole photos, likewise.
    c_cameras: Vec<Option<[zs_camera; 2]>>,
}

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_camera_source {
    ZS_CAMERA_SOURCE_DECODER = 0,
    ZS_CAMERA_SOURCE_RAYS = 1,
}

pub(super) type zs_camera_source_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_model_options {
    pub struct_size: u32,
    pub precision: zs_precision_value,
    pub progress: zs_progress_callback,
    pub user_data: *mut c_void,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_model_info {
    pub struct_size: u32,
    pub is_multi_view: u32,
    pub patch_size: u32,
    pub precision: zs_precision_value,
    pub weight_bytes: u64,
    pub warnings: *const c_char,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_options {
    pub struct_size: u32,
    pub input_size: u32,
    pub camera_source: zs_camera_source_value,
    pub per_view_focal: u32,
    pub camera_count: usize,
    pub cameras: *const zs_camera,
    pub progress: zs_progress_callback,
    pub user_data: *mut c_void,
    pub keep_features: u32,
    pub reserved: u32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_result_info {
    pub struct_size: u32,
    pub reserved: u32,
    pub view_count: usize,
    pub channel_count: usize,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_map {
    pub struct_size: u32,
    pub reserved: u32,
    pub width: u32,
    pub height: u32,
    pub depth: *const f32,
    pub confidence: *const f32,
    pub sky: *const f32,
    pub camera: *const zs_camera,
    pub image_camera: *const zs_camera,
}

versioned!(
    zs_depth_model_options,
    zs_depth_model_info,
    zs_depth_options { reserved },
    zs_depth_result_info { reserved },
    zs_depth_map { reserved }
);

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
        let checkpoint = DepthCheckpoint::whole(|heads| DepthCheckpoint::parse(path, heads))?;
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let progress = |fraction| reporter.fraction("weights", fraction);
        let model = DepthModel::from_checkpoint(&device.gpu, &checkpoint, chosen.arithmetic, progress)?;
        let warnings = [device.gpu.passed_over(), &chosen.warnings].concat();
        Ok(zs_depth_model { model, precision: chosen.precision, warnings: c_text(&warnings.join("\n")) })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(model, load) }
}

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

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_model_destroy(model: *mut zs_depth_model) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(model) }
}

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
        let sources = [CameraSource::Decoder, CameraSource::Rays];
        let source = meaning("camera_source", options.camera_source, "zs_camera_source", sources)?;
        let shares_focal = !flag("per_view_focal", options.per_view_focal)?;
        // SAFETY: the caller's arrays.
        let (images, known) = unsafe {
            (read_array(images, image_count, "images")?, read_array(options.cameras, options.camera_count, "cameras")?)
        };
        if !known.is_empty() && known.len() != images.len() {
            return Err(Failure::argument("number of cameras", known.len(), format!("0 or {image_count}")));
        }
        let known: Vec<Camera> = known.iter().map(Camera::from).collect();
        // SAFETY: the caller's pixels.
        let photo = |i: usize| unsafe { images[i].image(&format!("image {i}")) };
        let input_size = Some(options.input_size).filter(|size| *size > 0);
        let views = bounded_views(image_count, photo, model.architecture().fitting(), input_size)?;
        let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
        let of_view = |(i, (camera, view)): (usize, (&Camera, &View))| view.map.camera(camera, &format!("camera {i}"));
        let of_views: Vec<Camera> = known.iter().zip(&views).enumerate().map(of_view).collect::<Result<_, _>>()?;
        let known_cameras = (!known.is_empty()).then_some(of_views);
        let keep_features = flag("keep_features", options.keep_features)?;
        let request = DepthOptions { cameras: known_cameras.clone(), keep_features, ..DepthOptions::default() };
        let reporter = Reporter { callback: options.progress, user_data: options.user_data };
        let progress = |now: Progress<'_>| reporter.fraction(now.scope, now.fraction);
        let mut depths = model.predict(&images, &request, progress)?;
        let cameras = match known_cameras {
            Some(known_cameras) => {
                // Coincident cameras have no scale: depth keeps the network's.
                _ = depths.align_to_cameras(&known_cameras);
                known_cameras.into_iter().map(Some).collect()
            }
            None if !model.architecture().multi_view() => vec![None; images.len()],
            None => {
                let maps: Vec<PixelMap> = views.iter().map(|view| view.map).collect();
                // Photos of equal size share a lens.
                let lens = |map: &PixelMap| maps.iter().position(|other| other.from == map.from).unwrap_or_default();
                let lenses = shares_focal.then(|| maps.iter().map(lens).collect::<Vec<_>>());
                let found = depths.estimate_cameras(source, &maps, lenses.as_deref())?;
                found.into_iter().map(Result::ok).collect()
            }
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

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_get_info(
    depths: *const zs_depth_result,
    info: *mut zs_depth_result_info,
) -> zs_status {
    let of = |zs_depth_result { depths, images, .. }: &zs_depth_result| {
        let channel_count = depths.patch_tokens.first().map_or(0, |tokens| tokens.channels);
        Ok(zs_depth_result_info { view_count: images.len(), channel_count, ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(depths, "depths", info, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_get_map(
    depths: *const zs_depth_result,
    index: usize,
    map: *mut zs_depth_map,
) -> zs_status {
    let of = |zs_depth_result { depths, c_cameras, .. }: &zs_depth_result| {
        let values = |values: &Option<Vec<f32>>| values.as_ref().map_or(null(), |values| values.as_ptr());
        let camera = |which: usize| c_cameras[index].as_ref().map_or(null(), |cameras| &raw const cameras[which]);
        let DepthMap { depth, confidence, sky, .. } = element(&depths.views, index)?;
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

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_get_patch_tokens(
    depths: *const zs_depth_result,
    index: usize,
    tokens: *mut zs_pixel_values,
) -> zs_status {
    let of = |zs_depth_result { depths, .. }: &zs_depth_result| match &depths.patch_tokens[..] {
        [] => Err(Failure::argument("depths", "without features", "those of zs_depth_predict with keep_features = 1")),
        all => Ok(element(all, index)?.into()),
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(depths, "depths", tokens, of) }
}

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

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_destroy(depths: *mut zs_depth_result) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(depths) }
}
