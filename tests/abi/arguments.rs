use crate::calls::*;
use std::{
    ffi::{CStr, c_void},
    ptr::{null, null_mut},
    sync::atomic::{AtomicU32, Ordering},
    thread::{self, ThreadId},
};
use zipsplat::reconstruct::MAX_VIEWS;
use zipsplat_c::{zs_status::*, *};

#[test]
fn null_is_refused_everywhere() {
    let refused = [
        // SAFETY: every pointer may be NULL.
        unsafe { zs_device_count(null_mut()) },
        unsafe { zs_device_get(0, null_mut()) },
        unsafe { zs_device_create(null(), null_mut()) },
        unsafe { zs_device_get_info(null(), null_mut()) },
        unsafe { zs_image_buffer_open(null(), null_mut()) },
        unsafe { zs_image_buffer_from_memory(null(), 0, null_mut()) },
        unsafe { zs_image_buffer_get_image(null(), null_mut()) },
        unsafe { zs_image_save_png(null(), null()) },
        unsafe { zs_scene_get_gaussians(null(), null_mut()) },
        unsafe { zs_scene_create(null(), null_mut()) },
        unsafe { zs_scene_open(null(), null(), null_mut()) },
        unsafe { zs_scene_from_memory(null(), 0, null(), null_mut()) },
        unsafe { zs_scene_to_memory(null(), null(), null(), null_mut()) },
        unsafe { zs_blob_get(null(), null_mut(), null_mut()) },
        unsafe { zs_scene_save(null(), null(), null()) },
        unsafe { zs_model_load(null(), null(), null(), null_mut()) },
        unsafe { zs_model_from_memory(null(), null(), 0, null(), null_mut()) },
        unsafe { zs_model_get_info(null(), null_mut()) },
        unsafe { zs_reconstruct(null(), null(), 0, null(), null_mut()) },
        unsafe { zs_renderer_create(null(), null(), null_mut()) },
        unsafe { zs_renderer_set_scene(null_mut(), null()) },
        unsafe { zs_renderer_set_reconstruction(null_mut(), null()) },
        unsafe { zs_renderer_update_gaussians(null_mut(), null()) },
        unsafe { zs_render(null(), null(), null(), 0, null()) },
        unsafe { zs_reconstruction_get_info(null(), null_mut()) },
        unsafe { zs_reconstruction_to_scene(null(), null_mut()) },
        unsafe { zs_reconstruction_estimate_camera(null(), 0, null_mut()) },
        unsafe { zs_scene_get_info(null(), null_mut()) },
        unsafe { zs_scene_from_points(null(), null(), 0, null(), 0, null_mut()) },
        unsafe { zs_scene_from_photos(null(), null(), 0, null(), null(), 0, null_mut()) },
        unsafe { zs_vulkan_requirements(null_mut(), null_mut()) },
        unsafe { zs_device_from_vulkan(null(), null_mut()) },
        unsafe { zs_render_to_vulkan(null(), null(), null(), null()) },
    ];
    for (i, status) in refused.into_iter().enumerate() {
        assert_eq!(status, ZS_ERROR_ARGUMENT, "call {i}");
    }
    unsafe {
        zs_device_destroy(null_mut());
        zs_image_buffer_destroy(null_mut());
        zs_blob_destroy(null_mut());
        zs_model_destroy(null_mut());
        zs_scene_destroy(null_mut());
        zs_reconstruction_destroy(null_mut());
        zs_renderer_destroy(null_mut());
    }
}

#[test]
fn failures_leave_null_behind() {
    let device = open_device();
    let text = c_string("no such file");
    let scene = Object::try_new(|out| unsafe { zs_scene_open(text.as_ptr(), null(), out) });
    refused(scene, ZS_ERROR_IO, &["no such file"]);
    refused(model_from(&device, b"no model", null()), ZS_ERROR_FORMAT, &["model in memory"]);
    let device = c_string("no such device");
    let options = zs_device_options { device: device.as_ptr(), ..Versioned::new() };
    refused(try_device(&options), ZS_ERROR_NO_DEVICE, &["no such device"]);
    let bad = [b'x', 0xff, 0];
    fails(unsafe { zs_image_buffer_open(bad.as_ptr().cast(), &mut null_mut()) }, ZS_ERROR_ARGUMENT, &["path", "UTF-8"]);
}

#[test]
fn structures_of_other_sizes_are_refused() {
    for size in [0, 1, 4, 12, 16, 17, 24, 40, u32::MAX] {
        let options = zs_device_options { struct_size: size, ..Versioned::new() };
        let status = unsafe { zs_device_create(&options, &mut null_mut()) };
        fails(status, ZS_ERROR_ARGUMENT, &["zs_device_options", "struct_size"]);
    }
}

#[test]
fn structures_of_arrays_say_their_size() {
    let device = open_device();
    let model = model(&device);
    let photos = photos(2);
    let good = image_of(&photos[0]);
    for struct_size in [0, good.struct_size - 1, good.struct_size + 8, u32::MAX] {
        for images in [[zs_image { struct_size, ..good }, good], [good, zs_image { struct_size, ..good }]] {
            assert_eq!(try_reconstruct(&model, &images, &reconstruct_options()).err(), Some(ZS_ERROR_ARGUMENT));
            assert!(message().starts_with("zs_image, struct_size"), "{}", message());
        }
    }
    let camera = zs_camera { struct_size: 8, ..camera(SIDE, SIDE, 0.0) };
    let options = zs_reconstruct_options { cameras: &camera, camera_count: 1, ..reconstruct_options() };
    assert_eq!(try_reconstruct(&model, &[good], &options).err(), Some(ZS_ERROR_ARGUMENT));
    assert!(message().starts_with("zs_camera, struct_size"), "{}", message());
    let mut photo = zs_image { struct_size: 0, ..good };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("photo.png");
    photos[0].save_png(&path).expect("a photo can be written");
    let path = c_string(path.to_str().expect("UTF-8"));
    let opened = Object::new(|out| unsafe { zs_image_buffer_open(path.as_ptr(), out) });
    let status = unsafe { zs_image_buffer_get_image(opened.handle, &mut photo) };
    fails(status, ZS_ERROR_ARGUMENT, &["zs_image, struct_size"]);
}

#[test]
fn devices_are_described() {
    let mut count = 0;
    ok(unsafe { zs_device_count(&mut count) });
    let mut info = zs_device_info::new();
    fails(unsafe { zs_device_get(count, &mut info) }, ZS_ERROR_ARGUMENT, &["device"]);
    let device = open_device();
    ok(unsafe { zs_device_get_info(device.handle, &mut info) });
    let name: String = info.name.iter().take_while(|c| **c != 0).map(|c| *c as u8 as char).collect();
    assert_eq!(name, zipsplat_tests::device::device().limits().name);
    assert!(count > 0 && info.usable == 1 && info.memory_bytes > 0);
    for index in 0..count {
        ok(unsafe { zs_device_get(index, &mut info) });
        if info.usable == 0 {
            continue;
        }
        let number = c_string(index.to_string());
        for device in [number.as_ptr(), info.uuid.as_ptr()] {
            let options = zs_device_options { device, ..Versioned::new() };
            let device = made(try_device(&options));
            ok(unsafe { zs_device_get_info(device.handle, &mut info) });
            assert_eq!(info.index as usize, index);
        }
    }
}

#[test]
fn memory_can_be_limited() {
    let options = zs_device_options { max_memory_bytes: 4096, ..Versioned::new() };
    let device = made(try_device(&options));
    refused(model_from(&device, micro(), null()), ZS_ERROR_OUT_OF_MEMORY, &["4096 bytes"]);
}

unsafe extern "C" fn stop_at_third(calls: *mut c_void, progress: *const zs_progress) -> i32 {
    let zs_progress { struct_size, fraction, stage, .. } = unsafe { *progress };
    assert!((0.0..=1.0).contains(&fraction) && !stage.is_null());
    assert_eq!(struct_size as usize, size_of::<zs_progress>());
    // SAFETY: the counter of the calling test.
    let calls = unsafe { &*calls.cast::<AtomicU32>() };
    (calls.fetch_add(1, Ordering::Relaxed) == 2).into()
}

#[test]
fn progress_is_told_and_can_stop() {
    let device = open_device();
    let calls = AtomicU32::new(0);
    let user_data = (&raw const calls).cast_mut().cast();
    let options = zs_model_options { progress: Some(stop_at_third), user_data, ..Versioned::new() };
    refused(try_model_with(&device, &options), ZS_ERROR_CANCELLED, &["cancelled"]);
    assert_eq!(calls.swap(0, Ordering::Relaxed), 3);
    let model = crate::calls::model(&device);
    let photos = photos(2);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let options = zs_reconstruct_options { progress: Some(stop_at_third), user_data, ..reconstruct_options() };
    refused(try_reconstruct(&model, &images, &options), ZS_ERROR_CANCELLED, &[]);
    let options = zs_model_options { precision: 9, ..Versioned::new() };
    refused(try_model_with(&device, &options), ZS_ERROR_ARGUMENT, &["precision", "9"]);
    reconstruct(&model, &images, &reconstruct_options());
}

struct CallLog {
    stages: Vec<(f64, String)>,
    most: usize,
    thread: ThreadId,
}

unsafe extern "C" fn listen(log: *mut c_void, progress: *const zs_progress) -> i32 {
    // SAFETY: owned by the test, which waits for the call; the library's structure and string.
    let (log, fraction, stage) =
        unsafe { (&mut *log.cast::<CallLog>(), (*progress).fraction, CStr::from_ptr((*progress).stage)) };
    assert_eq!(log.thread, thread::current().id());
    log.stages.push((fraction, stage.to_str().expect("UTF-8").to_owned()));
    (log.stages.len() == log.most).into()
}

#[test]
fn photos_are_prepared_with_progress() {
    let device = open_device();
    let models = [0, 1].map(|tokens| made(try_model_with(&device, &zs_model_options { tokens, ..Versioned::new() })));
    let at_once = rayon::current_num_threads().min(MAX_VIEWS / 3);
    let photos = photos(2 * at_once as u32 + 1);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    for (model, most, status) in [(0, 2, ZS_ERROR_CANCELLED), (0, usize::MAX, ZS_OK), (1, usize::MAX, ZS_OK)] {
        let mut log = CallLog { stages: Vec::new(), most, thread: thread::current().id() };
        let user_data = (&raw mut log).cast();
        let options = zs_reconstruct_options { progress: Some(listen), user_data, ..reconstruct_options() };
        assert_eq!(try_reconstruct(&models[model], &images, &options).err().unwrap_or(ZS_OK), status);
        let (fractions, stages): (Vec<f64>, Vec<String>) = log.stages.into_iter().unzip();
        let prepared = stages.iter().take_while(|stage| *stage == "photos").count();
        assert_eq!(prepared, most.min(3), "{stages:?}");
        assert!(fractions.is_sorted() && fractions[0] == 0.0 && fractions.iter().all(|f| *f <= 1.0), "{fractions:?}");
        assert!(status != ZS_OK || stages.len() > prepared, "{stages:?}");
    }
}

#[test]
fn what_cannot_be_reconstructed_is_refused() {
    let device = open_device();
    let model = model(&device);
    let photos = photos(1);
    let image = image_of(&photos[0]);
    let options = reconstruct_options();
    let refuses = |images: &[zs_image], count: usize, options: &zs_reconstruct_options, words: &[&str]| {
        // SAFETY: oversized counts are rejected unread.
        let make = |out| unsafe { zs_reconstruct(model.handle, images.as_ptr(), count, options, out) };
        refused(Object::try_new(make), ZS_ERROR_ARGUMENT, words);
    };
    for count in [0, 65_537, usize::MAX, usize::MAX / 32 + 2] {
        refuses(&[image], count, &options, &["images"]);
    }
    for (width, height) in [(0, 1), (1, 0), (u32::MAX, u32::MAX), (32_769, 1), (32_768, 32_768)] {
        refuses(&[zs_image { width, height, ..image }], 1, &options, &["image 0, size"]);
    }
    for stride in [1, -1, 3 * i64::from(SIDE) - 1, i64::MAX, i64::MIN] {
        refuses(&[zs_image { stride, ..image }], 1, &options, &["image 0, stride"]);
    }
    for format in [-1, 5, i32::MAX] {
        refuses(&[zs_image { format, ..image }], 1, &options, &["pixel format"]);
    }
    refuses(&[zs_image { pixels: null(), ..image }], 1, &options, &["image 0", "NULL"]);
    for ratio in [-0.5, 1.5, f64::NAN, f64::INFINITY] {
        refuses(&[image], 1, &zs_reconstruct_options { ratio, ..options }, &["ratio"]);
    }
    for scene_scale in [-1.0, 1e-50, 1e50, f64::NAN, f64::INFINITY] {
        refuses(&[image], 1, &zs_reconstruct_options { scene_scale, ..options }, &["scene scale", "length"]);
    }
    for input_size in [[14, 0], [15, 14], [u32::MAX, 14], [1 << 31, 1 << 31], [14 * 4096, 14 * 4096]] {
        refuses(&[image], 1, &zs_reconstruct_options { input_size, ..options }, &["size of the views"]);
    }
    refuses(&[image], 1, &zs_reconstruct_options { world: 2, ..options }, &["world", "cameras"]);
    refuses(&[image], 1, &zs_reconstruct_options { world: 3, ..options }, &["world", "zs_world"]);
    refuses(&[image], 1, &zs_reconstruct_options { token_selection: -1, ..options }, &["token_selection"]);
    refuses(&[image], 1, &zs_reconstruct_options { camera_count: 1, ..options }, &["cameras", "NULL"]);
    let cameras = [camera(SIDE, SIDE, f64::NAN); 2];
    let posed = zs_reconstruct_options { cameras: cameras.as_ptr(), camera_count: 2, ..options };
    refuses(&[image], 1, &posed, &["cameras", "found 2"]);
    refuses(&[image], 1, &zs_reconstruct_options { camera_count: 1, ..posed }, &["camera 0", "translation"]);
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    let device = open_device();
    let photos = photos(1);
    let scene = reconstruct(&model(&device), &[image_of(&photos[0])], &reconstruct_options());
    let renderer = renderer(&device, &scene);
    let good = camera(16, 16, 0.0);
    let mut pixels = [0u8; 4 * 16 * 16];
    let picture = picture_at(pixels.as_mut_ptr());
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGBA8);
    let refused =
        |camera: &zs_camera, picture: &zs_render_buffers, count: usize, options: &zs_render_options, word: &str| {
            // SAFETY: oversized pictures are rejected unread.
            let status = unsafe { zs_render(renderer.handle, camera, picture, count, options) };
            fails(status, ZS_ERROR_ARGUMENT, &[word]);
        };
    refused(&good, &picture, usize::MAX, &options, "cameras");
    for (width, height) in [(0, 16), (16, 0), (u32::MAX, u32::MAX), (1 << 20, 1)] {
        refused(&zs_camera { width, height, ..good }, &picture, 1, &options, "size");
    }
    for focal in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        refused(&zs_camera { fx: focal, ..good }, &picture, 1, &options, "fx");
    }
    refused(&zs_camera { rotation: [0.0; 9], ..good }, &picture, 1, &options, "rotation");
    refused(&zs_camera { reserved: 1, ..good }, &picture, 1, &options, "cameras 0, reserved");
    refused(&good, &zs_render_buffers { reserved: 1, ..picture }, 1, &options, "pictures 0, reserved");
    refused(&good, &zs_render_buffers { stride: 63, ..picture }, 1, &options, "stride");
    refused(&good, &zs_render_buffers { stride: i64::MIN, ..picture }, 1, &options, "stride");
    refused(&good, &zs_render_buffers { pixels: null_mut(), ..picture }, 1, &options, "no output");
    refused(&good, &picture, 1, &zs_render_options { format: 5, ..options }, "pixel format");
    refused(&good, &picture, 1, &zs_render_options { depth: 7, ..options }, "depth");
    refused(&good, &picture, 1, &zs_render_options { near_plane: -1.0, ..options }, "near_plane");
    refused(&good, &picture, 1, &zs_render_options { antialiasing: 3, ..options }, "antialiasing");
    refused(&good, &picture, 1, &zs_render_options { background: [f32::NAN; 3], ..options }, "background");
    // SAFETY: zero cameras are not accessed.
    ok(unsafe { zs_render(renderer.handle, null(), null(), 0, null()) });
    let status = unsafe { zs_render_to_vulkan(renderer.handle, &good, null(), null()) };
    fails(status, ZS_ERROR_ARGUMENT, &["zs_device_from_vulkan"]);
}

#[test]
fn what_is_no_scene_is_refused() {
    let gaussians = zipsplat::types::Scene {
        means: vec![[0.0; 3]],
        scales: vec![[1.0; 3]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
        opacities: vec![0.5],
        sh_coeffs: vec![[0.0; 3]],
        ..zipsplat::types::Scene::default()
    };
    let array = arrays(&gaussians);
    let refuses = |array: &zs_gaussians, word: &str| {
        // SAFETY: oversized arrays are rejected unread.
        let make = |out| unsafe { zs_scene_create(array, out) };
        refused(Object::try_new(make), ZS_ERROR_ARGUMENT, &[word]);
    };
    for count in [usize::MAX, 1 << 40, (1 << 28) + 1] {
        refuses(&zs_gaussians { count, ..array }, "gaussians");
    }
    refuses(&zs_gaussians { sh_degree: 4, ..array }, "sh_degree");
    refuses(&zs_gaussians { sh_degree: u32::MAX, ..array }, "sh_degree");
    refuses(&zs_gaussians { antialiased: 2, ..array }, "antialiased");
    refuses(&zs_gaussians { reserved: 1, ..array }, "reserved");
    refuses(&zs_gaussians { means: null(), ..array }, "means");
    refuses(&zs_gaussians { struct_size: 999, ..array }, "struct_size");
    let opacity = [2.0f32];
    refuses(&zs_gaussians { opacities: opacity.as_ptr(), ..array }, "opacities");
    let scene = Object::new(|out| unsafe { zs_scene_create(&array, out) });
    let status = unsafe { zs_scene_get_gaussians(scene.handle, &mut zs_gaussians { struct_size: 0, ..array }) };
    fails(status, ZS_ERROR_ARGUMENT, &["zs_gaussians", "struct_size"]);
    let path = c_string("scene.unknown");
    fails(unsafe { zs_scene_save(scene.handle, path.as_ptr(), null()) }, ZS_ERROR_ARGUMENT, &["scene file"]);
}

#[test]
fn handles_that_cannot_be_adopted_are_refused() {
    let vulkan = zs_vulkan_device::new();
    unsafe extern "C" fn lock(_: *mut c_void) {}
    for (vulkan, word) in [
        (vulkan, "null"),
        (zs_vulkan_device { lock_queue: Some(lock), ..vulkan }, "unlock_queue"),
        (zs_vulkan_device { reserved: 1, ..vulkan }, "reserved"),
    ] {
        // SAFETY: null handles are rejected before use.
        let make = |out| unsafe { zs_device_from_vulkan(&vulkan, out) };
        refused(Object::try_new(make), ZS_ERROR_ARGUMENT, &[word]);
    }
}
