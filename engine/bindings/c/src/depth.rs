//! Depth: per-pixel depth and cameras of photos.

use super::{
    camera::zs_camera,
    device::zs_device,
    image::zs_image,
    model::{report, zs_model_options, zs_precision, zs_progress},
    pointers::{Versioned, borrow, destroy, produce, read_array, read_versioned, text, write_versioned},
    scene::zs_scene,
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{c_char, c_void},
    ptr::null,
};
use zipsplat::{
    Error,
    cameras::share_focal_lengths,
    depth::{DepthMap, DepthModel, DepthOptions, DepthPrediction},
    gpu::Progress,
    reconstruct::MAX_VIEWS,
    tune::KernelChoice,
    types::{
        Camera, DEFAULT_BOUND, Image, bounded_views,
        preprocess::{PixelMap, View},
    },
    weights::DepthCheckpoint,
};

/// A Depth Anything 3 network with its weights on a device.
pub struct zs_depth_model {
    model: DepthModel,
}

/// Depth and cameras of photos.
pub struct zs_depth_result {
    depths: DepthPrediction,
    images: Vec<Image>,
    /// Cameras of the views and of the whole photos; `None` if unknown.
    cameras: Vec<Option<[Camera; 2]>>,
}

/// Sources of estimated cameras.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_camera_source {
    /// The camera decoder.
    ZS_CAMERA_SOURCE_DECODER = 0,
    /// The ray maps, principal point included. Photos with inconsistent rays get no camera.
    ZS_CAMERA_SOURCE_RAYS = 1,
}

pub(super) type zs_camera_source_value = i32;

/// Options of zs_depth_predict.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_options {
    /// sizeof(zs_depth_options).
    pub struct_size: u32,
    /// Longer side of the network's input, 14 to 8192 pixels. Each side is rounded to a multiple of
    /// 14. Photos of different shapes are cropped to their common center. 0 is 504.
    pub input_size: u32,
    /// Source of estimated cameras.
    pub camera_source: zs_camera_source_value,
    /// 1 estimates a focal length per photo; 0 shares the confidence-weighted median among photos
    /// of equal size.
    pub per_view_focal: u32,
    /// 0 or the number of photos.
    pub camera_count: usize,
    /// Known cameras of the whole photos, for multi-view networks. They set the depth scale and are
    /// returned unchanged.
    pub cameras: *const zs_camera,
    /// Progress callback.
    pub progress: zs_progress,
    /// Argument of `progress`.
    pub user_data: *mut c_void,
}

/// Depth of a photo, in memory of its zs_depth_result. Arrays are `[height][width]`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_depth_view {
    /// sizeof(zs_depth_view).
    pub struct_size: u32,
    /// 0.
    pub reserved: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
    /// Distance along the camera's axis, in the scale of the cameras, shared by all views.
    pub depth: *const f32,
    /// Confidence, at least 1, from multi-view networks; else NULL.
    pub confidence: *const f32,
    /// Sky score, at least 0 and above 0.3 for sky, from single-view networks; else NULL.
    pub sky: *const f32,
}

versioned!(zs_depth_options, zs_depth_view);

// SAFETY: the arrays belong to an immutable object.
unsafe impl Sync for zs_depth_view {}

/// Loads a Depth Anything 3 network: a released model.safetensors at `path`, or random weights for
/// "seeded:NAME", such as "seeded:da3-small". The options' `variant` must be NULL and `tokens` 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_model_load(
    device: *const zs_device,
    path: *const c_char,
    options: *const zs_model_options,
    model: *mut *mut zs_depth_model,
) -> zs_status {
    let load = || {
        // SAFETY: the caller's objects.
        let (device, path, options) =
            unsafe { (borrow(device, "device")?, text(path, "path")?, read_versioned(options)?) };
        if !options.variant.is_null() || options.tokens != 0 || options.reserved != 0 {
            let found = "a variant or tokens";
            return Err(Failure::argument(
                "options of a depth model",
                found,
                "NULL and 0, which are for zs_model_load",
            ));
        }
        let chosen = KernelChoice::of(&device.gpu, zs_precision::wanted(options.precision)?)?;
        let checkpoint = DepthCheckpoint::whole(|gaussians| DepthCheckpoint::parse(path, gaussians))?;
        let progress = |fraction| report(options.progress, options.user_data, fraction, "weights");
        Ok(zs_depth_model {
            model: DepthModel::from_checkpoint(&device.gpu, &checkpoint, chosen.arithmetic, progress)?,
        })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(model, load) }
}

/// Destroys a depth model.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_model_destroy(model: *mut zs_depth_model) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(model) }
}

/// Estimates depth of 1 to 192 photos of one place. Multi-view networks also estimate cameras,
/// relative to one of them.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_predict(
    model: *const zs_depth_model,
    images: *const zs_image,
    image_count: usize,
    options: *const zs_depth_options,
    depths: *mut *mut zs_depth_result,
) -> zs_status {
    let find = || {
        // SAFETY: an object or NULL; a structure or NULL.
        let (zs_depth_model { model }, options) = unsafe { (borrow(model, "model")?, read_versioned(options)?) };
        if !(1..=MAX_VIEWS).contains(&image_count) {
            return Err(Failure::argument("number of images", image_count, format!("1 to {MAX_VIEWS}")));
        }
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
        let photo = |(i, image): (usize, &zs_image)| unsafe { image.image(&format!("image {i}")) };
        let photos = images.iter().enumerate().map(photo).collect::<Result<Vec<Image>, _>>()?;
        let input_size = if options.input_size == 0 { DEFAULT_BOUND } else { options.input_size };
        let views = bounded_views(&photos, input_size)?;
        drop(photos);
        let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
        let known_cameras = (!known.is_empty()).then(|| of_views(&known, &views)).transpose()?;
        let request = DepthOptions { cameras: known_cameras.clone(), ..DepthOptions::default() };
        let progress = |now: Progress<'_>| report(options.progress, options.user_data, now.fraction, now.scope);
        let mut depths = model.predict(&images, &request, progress)?;
        let cameras = match known_cameras {
            Some(known_cameras) => {
                // Coincident cameras have no scale: depth keeps the network's.
                depths
                    .align_to_cameras(&known_cameras)
                    .or_else(|error| if known_cameras.len() > 1 { Err(error) } else { Ok(()) })?;
                known_cameras.into_iter().zip(known).map(|(of_view, of_photo)| Some([of_view, of_photo])).collect()
            }
            None if !model.architecture().multi_view() => vec![None; images.len()],
            None => found_cameras(&depths, &views, by_rays, options.per_view_focal == 0)?,
        };
        Ok(zs_depth_result { depths, images, cameras })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(depths, find) }
}

/// Returns depth and camera of photo `index`. The camera is of the whole photo, in the common
/// world; width and height are 0 if unknown. Outputs may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_get(
    depths: *const zs_depth_result,
    index: usize,
    view: *mut zs_depth_view,
    camera: *mut zs_camera,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let zs_depth_result { depths, cameras, .. } = unsafe { borrow(depths, "depths") }?;
        let expected = || format!("a number below {}", depths.views.len());
        let found = depths.views.get(index).ok_or_else(|| Failure::argument("number of a photo", index, expected()))?;
        let values = |values: &Option<Vec<f32>>| values.as_ref().map_or(null(), |values| values.as_ptr());
        if !view.is_null() {
            let DepthMap { depth, confidence, sky, .. } = found;
            let found = zs_depth_view {
                width: depths.width,
                height: depths.height,
                depth: depth.as_ptr(),
                confidence: values(confidence),
                sky: values(sky),
                ..Versioned::new()
            };
            // SAFETY: the caller's structure.
            unsafe { write_versioned(view, found) }?;
        }
        if !camera.is_null() {
            let found = cameras[index].map_or_else(Versioned::new, |[_, of_photo]| zs_camera::from(&of_photo));
            // SAFETY: the caller's structure.
            unsafe { write_versioned(camera, found) }?;
        }
        Ok(())
    })
}

/// Creates a scene with a Gaussian per confident pixel of each posed photo, in the cameras' world.
/// Each patch of 14 x 14 pixels keeps its `max_gaussians_per_patch` most visible ones; 0 keeps all.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_depth_result_to_scene(
    depths: *const zs_depth_result,
    max_gaussians_per_patch: u32,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let make = || {
        // SAFETY: an object or NULL.
        let zs_depth_result { depths, images, cameras } = unsafe { borrow(depths, "depths") }?;
        let posed: Vec<usize> = (0..images.len()).filter(|&i| cameras[i].is_some()).collect();
        if posed.is_empty() {
            let expected = "photos whose cameras were given, or found by a network that sees all photos at once";
            return Err(Failure::argument("cameras of the depths", "none", expected));
        }
        let mut seen = depths.clone();
        seen.keep_views(&cameras.iter().map(Option::is_some).collect::<Vec<_>>());
        let of_views: Vec<Camera> = cameras.iter().flatten().map(|[of_view, _]| *of_view).collect();
        let images: Vec<Image> = posed.iter().map(|&i| images[i].clone()).collect();
        Ok(seen
            .scene(&of_views, &images, (max_gaussians_per_patch > 0).then_some(max_gaussians_per_patch as usize))
            .into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, make) }
}

/// Destroys depths.
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
) -> Result<Vec<Option<[Camera; 2]>>, Error> {
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
        all[i] = Some([camera, Camera { intrinsics: views[i].map.undo(&camera.intrinsics), ..camera }]);
    }
    Ok(all)
}
