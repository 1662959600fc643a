//! Calls of the C ABI that panic on failure.

use std::{
    ffi::{CStr, CString},
    ops::ControlFlow::Continue,
    ptr::null,
    sync::OnceLock,
};
use zipsplat::{
    reconstruct::{Model, ReconstructOptions},
    types::{Camera, Image, Intrinsics, Pose, Scene},
    weights::{Checkpoint, Dtype},
};
use zipsplat_c::*;
use zipsplat_tests::{architectures, device::device as rust_device};

pub trait Handle: Sized {
    const DESTROY: unsafe extern "C" fn(*mut Self);
}

macro_rules! handles {
    ($($name:ident $destroy:ident)*) => {
        $(impl Handle for $name {
            const DESTROY: unsafe extern "C" fn(*mut Self) = $destroy;
        })*
    };
}

handles! {
    zs_blob zs_blob_destroy
    zs_capture zs_capture_destroy
    zs_depth_model zs_depth_model_destroy
    zs_depth_result zs_depth_result_destroy
    zs_device zs_device_destroy
    zs_image_buffer zs_image_buffer_destroy
    zs_model zs_model_destroy
    zs_reconstruction zs_reconstruction_destroy
    zs_renderer zs_renderer_destroy
    zs_scene zs_scene_destroy
}

pub struct Object<T: Handle> {
    pub handle: *mut T,
}

// SAFETY: any thread may use and destroy objects.
unsafe impl<T: Handle> Send for Object<T> {}
unsafe impl<T: Handle> Sync for Object<T> {}

impl<T: Handle> Object<T> {
    pub fn new(make: impl FnOnce(*mut *mut T) -> zs_status) -> Self {
        made(Self::try_new(make))
    }

    pub fn try_new(make: impl FnOnce(*mut *mut T) -> zs_status) -> Result<Self, zs_status> {
        let mut handle = std::ptr::dangling_mut();
        let status = make(&mut handle);
        assert_eq!(status == zs_status::ZS_OK, !handle.is_null(), "{status:?}: {}", message());
        if handle.is_null() { Err(status) } else { Ok(Self { handle }) }
    }
}

impl<T: Handle> Drop for Object<T> {
    fn drop(&mut self) {
        // SAFETY: created by `new`, destroyed once.
        unsafe { T::DESTROY(self.handle) }
    }
}

#[track_caller]
pub fn made<T>(result: Result<T, zs_status>) -> T {
    result.unwrap_or_else(|status| panic!("{status:?}: {}", message()))
}

#[track_caller]
pub fn ok(status: zs_status) {
    assert!(status == zs_status::ZS_OK, "{status:?}: {}", message());
}

#[track_caller]
pub fn fails(status: zs_status, expected: zs_status, words: &[&str]) {
    assert_eq!(status, expected, "{}", message());
    for word in words {
        assert!(message().contains(word), "'{word}' is not in: {}", message());
    }
}

/// [`fails`] for a constructor, which leaves NULL.
#[track_caller]
pub fn refused<T>(result: Result<T, zs_status>, expected: zs_status, words: &[&str]) {
    fails(result.err().expect("it is refused"), expected, words);
}

pub fn message() -> String {
    // SAFETY: a string of this thread.
    unsafe { CStr::from_ptr(zs_last_error()) }.to_str().expect("UTF-8").to_owned()
}

pub fn micro() -> &'static [u8] {
    static MICRO: OnceLock<Vec<u8>> = OnceLock::new();
    MICRO.get_or_init(|| micro_in(Dtype::F32))
}

pub fn micro_in(dtype: Dtype) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("micro.safetensors");
    checkpoint().save(&path, dtype).expect("weights can be written");
    std::fs::read(path).expect("they were just written")
}

pub fn checkpoint() -> Checkpoint {
    Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").expect("a network")
}

pub fn open_device() -> Object<zs_device> {
    Object::new(|out| unsafe { zs_device_create(null(), out) })
}

pub fn try_device(options: &zs_device_options) -> Result<Object<zs_device>, zs_status> {
    Object::try_new(|out| unsafe { zs_device_create(options, out) })
}

pub fn model(device: &Object<zs_device>) -> Object<zs_model> {
    made(try_model(device))
}

pub fn try_model(device: &Object<zs_device>) -> Result<Object<zs_model>, zs_status> {
    try_model_with(device, &zs_model_options::new())
}

pub fn try_model_with(device: &Object<zs_device>, options: &zs_model_options) -> Result<Object<zs_model>, zs_status> {
    model_from(device, micro(), options)
}

pub fn model_from(
    device: &Object<zs_device>,
    bytes: &[u8],
    options: *const zs_model_options,
) -> Result<Object<zs_model>, zs_status> {
    let load = |out| unsafe { zs_model_from_memory(device.handle, bytes.as_ptr().cast(), bytes.len(), options, out) };
    Object::try_new(load)
}

pub const SIDE: u32 = 5 * 14;

pub fn photos(count: u32) -> Vec<Image> {
    let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8;
    let photo = |view: u32| Image::new(SIDE, SIDE, (0..3 * SIDE * SIDE).map(|i| noise(i + (view << 20) + 1)).collect());
    (0..count).map(|view| photo(view).expect("a picture")).collect()
}

pub fn image_of(photo: &Image) -> zs_image {
    zs_image {
        format: zs_pixel_format::ZS_PIXEL_RGB8 as i32,
        width: photo.width,
        height: photo.height,
        pixels: photo.rgb.as_ptr().cast(),
        mask: photo.mask.as_ref().map_or(std::ptr::null(), Vec::as_ptr),
        ..Versioned::new()
    }
}

pub fn reconstruct_options() -> zs_reconstruct_options {
    let world = zs_world::ZS_WORLD_FIRST_CAMERA as i32;
    zs_reconstruct_options { world, scene_scale: 1.0, input_size: [SIDE; 2], ..Versioned::new() }
}

pub fn reconstruct(
    model: &Object<zs_model>,
    images: &[zs_image],
    options: &zs_reconstruct_options,
) -> Object<zs_scene> {
    to_scene(&made(try_reconstruct(model, images, options)))
}

pub fn try_reconstruct(
    model: &Object<zs_model>,
    images: &[zs_image],
    options: &zs_reconstruct_options,
) -> Result<Object<zs_reconstruction>, zs_status> {
    let make = |out| unsafe { zs_reconstruct(model.handle, images.as_ptr(), images.len(), options, out) };
    Object::try_new(make)
}

pub fn rust_scene(checkpoint: &Checkpoint, views: &[Image], options: &ReconstructOptions) -> Scene {
    let model = Model::from_checkpoint(rust_device(), checkpoint, |_| Continue(())).expect("a model");
    model.reconstruct_views(views, options, |_| Continue(())).expect("a scene").to_scene().expect("Gaussians")
}

pub fn to_scene(reconstruction: &Object<zs_reconstruction>) -> Object<zs_scene> {
    made(try_to_scene(reconstruction))
}

pub fn try_to_scene(reconstruction: &Object<zs_reconstruction>) -> Result<Object<zs_scene>, zs_status> {
    Object::try_new(|out| unsafe { zs_reconstruction_to_scene(reconstruction.handle, out) })
}

pub fn open_scene(
    path: impl AsRef<std::path::Path>,
    options: &zs_scene_open_options,
) -> Result<Object<zs_scene>, zs_status> {
    let path = c_string(path.as_ref().to_str().expect("UTF-8"));
    Object::try_new(|out| unsafe { zs_scene_open(path.as_ptr(), options, out) })
}

pub fn renderer(device: &Object<zs_device>, scene: &Object<zs_scene>) -> Object<zs_renderer> {
    made(try_renderer(device, scene))
}

pub fn try_renderer(device: &Object<zs_device>, scene: &Object<zs_scene>) -> Result<Object<zs_renderer>, zs_status> {
    Object::try_new(|out| unsafe { zs_renderer_create(device.handle, scene.handle, out) })
}

pub fn render_options(format: zs_pixel_format) -> zs_render_options {
    zs_render_options { format: format as i32, ..Versioned::new() }
}

/// `right` of the origin, looking forward.
pub fn camera(width: u32, height: u32, right: f64) -> zs_camera {
    let (w, h) = (f64::from(width), f64::from(height));
    let intrinsics = Intrinsics { width, height, fx: w, fy: w, cx: w / 2.0, cy: h / 2.0 };
    in_c(&Camera { intrinsics, pose: Pose { translation: [right, 0.0, 0.0].into(), ..Pose::IDENTITY } })
}

pub fn in_c(Camera { intrinsics, pose }: &Camera) -> zs_camera {
    let Intrinsics { width, height, fx, fy, cx, cy } = *intrinsics;
    let (rotation, translation) = (pose.rotation.transpose().to_cols_array(), pose.translation.to_array());
    zs_camera { width, height, fx, fy, cx, cy, rotation, translation, ..Versioned::new() }
}

pub fn picture_at(pixels: *mut u8) -> zs_render_buffers {
    zs_render_buffers { pixels: pixels.cast(), ..Versioned::new() }
}

pub fn scene_of(scene: &Scene) -> Object<zs_scene> {
    let array = arrays(scene);
    Object::new(|out| unsafe { zs_scene_create(&array, out) })
}

pub fn read(scene: &Object<zs_scene>) -> Scene {
    let mut found = arrays(&Scene::default());
    ok(unsafe { zs_scene_get_gaussians(scene.handle, &mut found) });
    let (n, k) = (found.count, (found.sh_degree as usize + 1).pow(2));
    unsafe {
        Scene {
            means: std::slice::from_raw_parts(found.means.cast(), n).to_vec(),
            scales: std::slice::from_raw_parts(found.scales.cast(), n).to_vec(),
            quats: std::slice::from_raw_parts(found.quats.cast(), n).to_vec(),
            opacities: std::slice::from_raw_parts(found.opacities, n).to_vec(),
            sh_coeffs: std::slice::from_raw_parts(found.sh_coeffs.cast(), n * k).to_vec(),
            sh_degree: found.sh_degree,
            antialiased: found.antialiased == 1,
        }
    }
}

pub fn bits(scene: &Scene) -> Vec<u32> {
    let fields = [scene.means.as_flattened(), scene.scales.as_flattened(), scene.quats.as_flattened()];
    let fields = fields.into_iter().chain([&scene.opacities[..], scene.sh_coeffs.as_flattened()]);
    fields.flatten().map(|x| x.to_bits()).collect()
}

pub fn arrays(scene: &Scene) -> zs_gaussians {
    zs_gaussians {
        sh_degree: scene.sh_degree,
        count: scene.means.len(),
        means: scene.means.as_ptr().cast(),
        scales: scene.scales.as_ptr().cast(),
        quats: scene.quats.as_ptr().cast(),
        opacities: scene.opacities.as_ptr(),
        sh_coeffs: scene.sh_coeffs.as_ptr().cast(),
        antialiased: scene.antialiased.into(),
        ..Versioned::new()
    }
}

pub fn c_string(text: impl Into<Vec<u8>>) -> CString {
    CString::new(text).expect("no NUL")
}

pub fn draw(renderer: &Object<zs_renderer>, camera: &zs_camera, options: &zs_render_options, bytes: usize) -> Vec<u8> {
    made(try_draw(renderer, camera, options, bytes))
}

pub fn try_draw(
    renderer: &Object<zs_renderer>,
    camera: &zs_camera,
    options: &zs_render_options,
    bytes: usize,
) -> Result<Vec<u8>, zs_status> {
    let mut pixels = vec![0; (camera.width * camera.height) as usize * bytes];
    let picture = picture_at(pixels.as_mut_ptr());
    match unsafe { zs_render(renderer.handle, camera, &picture, 1, options) } {
        zs_status::ZS_OK => Ok(pixels),
        status => Err(status),
    }
}
