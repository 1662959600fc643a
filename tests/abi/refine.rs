use crate::{
    calls::*,
    header::root,
    installation::{Linking, installation, runner, success},
};
use std::{
    ffi::c_void,
    fmt::Write,
    ops::ControlFlow,
    ptr::{dangling_mut, null, null_mut},
};
use zipsplat::{
    gpu::Arena,
    refine::{Exposure, RefineLength, RefineOptions, RefineResult, refine_scene},
    stages::render::{RenderOptions, Renderer},
    types::{Camera, Image, Scene, read_ply, write_ply},
};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{
    compare::assert_same,
    device::device as rust_device,
    scenes::{camera, random_scene},
};

pub struct Place {
    pub cameras: Vec<Camera>,
    pub photos: Vec<Image>,
    pub moved: Scene,
}

pub fn place(count: usize) -> Place {
    let at = |i: usize| {
        let mut camera = camera(48, 36);
        camera.pose.translation.x += 0.05 * i as f64;
        camera
    };
    let cameras: Vec<Camera> = (0..count).map(at).collect();
    let mut moved = random_scene(60, 1, 0.3);
    let frames =
        Renderer::new(rust_device()).render_scene(&moved, &cameras, &RenderOptions::default()).expect("pictures");
    let photo = |frame: zipsplat::stages::render::RenderOutput| {
        Image::from_rgb_f32(frame.width, frame.height, &frame.rgb.expect("color")).expect("a photo")
    };
    let photos = frames.into_iter().map(photo).collect();
    moved.sh_coeffs.iter_mut().flatten().enumerate().for_each(|(i, value)| *value += 0.3 * (2.4 * i as f32).sin());
    Place { cameras, photos, moved }
}

impl Place {
    fn in_rust(&self, request: &RefineOptions, stop_after: usize) -> RefineResult {
        let progress = |now: zipsplat::refine::RefineProgress<'_>| {
            if now.step == stop_after { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        refine_scene(&Arena::new(rust_device()), &self.moved, &self.photos, &self.cameras, request, progress)
            .expect("a scene")
    }

    pub fn c_cameras(&self) -> Vec<zs_camera> {
        self.cameras.iter().map(in_c).collect()
    }

    pub fn in_c(&self, options: &zs_refine_options) -> Result<(Scene, zs_refine_result), zs_status> {
        let (device, scene) = (open_device(), scene_of(&self.moved));
        let images: Vec<_> = self.photos.iter().map(image_of).collect();
        let (cameras, mut info) = (self.c_cameras(), zs_refine_result::new());
        let (images, cameras, count) = (images.as_ptr(), cameras.as_ptr(), images.len());
        let refine = |out| unsafe {
            zs_refine_scene(device.handle, scene.handle, images, cameras, count, options, &mut info, out)
        };
        let refined = Object::try_new(refine)?;
        Ok((read(&refined), info))
    }
}

struct CallLog {
    steps: Vec<zs_progress>,
    stop_after: usize,
    action: zs_progress_action,
}

unsafe extern "C" fn listen(log: *mut c_void, now: *const zs_progress) -> i32 {
    // SAFETY: owned by the test, which waits for the call; `now` is the library's.
    let (log, now) = unsafe { (&mut *log.cast::<CallLog>(), *now) };
    log.steps.push(now);
    if now.step == log.stop_after { log.action as i32 } else { 0 }
}

#[test]
fn masked_photos_are_rusts() {
    let mut place = place(4);
    let mask: Vec<u8> = (0..48 * 36).map(|at| u8::from(at % 48 > 20)).collect();
    let bare = place.in_c(&zs_refine_options { steps: 9, ..Versioned::new() });
    place.photos.iter_mut().for_each(|photo| photo.mask = Some(mask.clone()));
    let (scene, _) = made(place.in_c(&zs_refine_options { steps: 9, ..Versioned::new() }));
    let request = RefineOptions { length: RefineLength::Steps(9), ..RefineOptions::default() };
    assert_same("scene", &bits(&scene), &bits(&place.in_rust(&request, usize::MAX).scene));
    assert_ne!(bits(&scene), bits(&made(bare).0));

    let folder = tempfile::tempdir().expect("a folder");
    let [photo, masks] = ["photo.png", "photo.png.png"].map(|name| folder.path().join(name));
    place.photos[0].save_png(&photo).expect("a photo");
    let rgb = mask.iter().flat_map(|kept| [255 * kept; 3]).collect();
    Image::new(48, 36, rgb).expect("a mask").save_png(&masks).expect("a mask");
    let [photo, masks] = [photo.as_path(), folder.path()].map(|path| c_string(path.to_str().expect("UTF-8")));
    let masks = zs_masks { inverted: 1, folder: masks.as_ptr(), ..Versioned::new() };
    let open = |out: *mut *mut _| unsafe { zs_image_buffer_open_masked(photo.as_ptr(), &masks, out) };
    let opened = Object::new(open);
    let mut image = zs_image::new();
    ok(unsafe { zs_image_buffer_get_image(opened.handle, &mut image) });
    let found = unsafe { std::slice::from_raw_parts(image.mask, mask.len()) };
    assert!(found.iter().zip(&mask).all(|(found, kept)| (*found == 0) == (*kept == 1)));
    let wrong = zs_masks { inverted: 2, ..masks };
    fails(unsafe { zs_image_buffer_open_masked(photo.as_ptr(), &wrong, null_mut()) }, ZS_ERROR_ARGUMENT, &[]);
}

#[test]
fn refinements_continue_from_checkpoints() {
    let mut place = place(4);
    let folder = tempfile::tempdir().expect("a folder");
    let [path, nowhere] =
        ["state", "none/state"].map(|name| c_string(folder.path().join(name).to_str().expect("UTF-8")));
    let mut log = CallLog { steps: Vec::new(), stop_after: 5, action: zs_progress_action::ZS_STOP };
    let options = zs_refine_options {
        steps: 9,
        checkpoint: path.as_ptr(),
        progress: Some(listen),
        user_data: (&raw mut log).cast(),
        ..Versioned::new()
    };
    let reason = |options| made(place.in_c(&options)).1.stop_reason;
    let unsaved = zs_refine_options { checkpoint: nowhere.as_ptr(), ..options };
    assert_eq!(reason(unsaved), zs_stop_reason::ZS_STOP_REASON_UNSAVED as i32);
    assert_eq!(reason(options), zs_stop_reason::ZS_STOP_REASON_STOPPED as i32);
    log = CallLog { steps: Vec::new(), stop_after: usize::MAX, ..log };
    let (resumed, _) = made(place.in_c(&options));
    assert_eq!(log.steps.len(), 4);
    let (whole, _) = made(place.in_c(&zs_refine_options { steps: 9, ..Versioned::new() }));
    assert_same("scene", &bits(&resumed), &bits(&whole));
    place.photos[3].rgb[0] ^= 1;
    fails(place.in_c(&options).err().expect("an error"), ZS_ERROR_ARGUMENT, &["state", "photos differ"]);
}

#[test]
fn a_refinement_is_rusts_and_tells_how_far_it_is() {
    let place = place(9);
    let mut log = CallLog { steps: Vec::new(), stop_after: usize::MAX, action: zs_progress_action::ZS_STOP };
    let options = zs_refine_options {
        steps: 12,
        views_per_step: 3,
        max_image_size: [40; 2],
        holdout_views: 1,
        seed: 7,
        progress: Some(listen),
        user_data: (&raw mut log).cast(),
        ..Versioned::new()
    };
    let (scene, info) = made(place.in_c(&options));
    let request = RefineOptions {
        length: RefineLength::Steps(12),
        views_per_step: 3,
        max_image_size: Some([40, 40]),
        holdout_views: Some(1),
        seed: 7,
        ..RefineOptions::default()
    };
    let expected = place.in_rust(&request, usize::MAX);
    assert_same("scene", &bits(&scene), &bits(&expected.scene));
    assert_ne!(bits(&scene), bits(&place.moved));
    let [psnr, before] = expected.psnr().expect("a photo is held out");
    let found = [info.initial_loss, info.final_loss, info.best_psnr, info.initial_psnr];
    assert_eq!(found, [f64::from(expected.losses[0]), f64::from(expected.losses[11]), psnr, before]);
    let ended = zs_stop_reason::ZS_STOP_REASON_FINISHED as i32;
    assert_eq!((info.stop_reason, info.steps, info.best_step as usize), (ended, 12, expected.best_step));
    assert!(psnr > before && info.seconds > 0.0, "{before} to {psnr} dB in {} s", info.seconds);
    let steps: Vec<_> = log.steps.iter().map(|now| (now.step, now.steps, now.loss)).collect();
    let losses = expected.losses.iter().zip(1..).map(|(loss, step)| (step, 12, f64::from(*loss)));
    assert_eq!(steps, losses.collect::<Vec<_>>());
    assert!(log.steps.iter().all(|now| now.psnr > 0.0 && now.eta_seconds >= 0.0));
    assert_eq!(log.steps[0].struct_size as usize, size_of::<zs_progress>());
}

#[test]
fn a_refinement_that_is_stopped_hands_out_the_best_so_far() {
    let place = place(3);
    let mut log = CallLog { steps: Vec::new(), stop_after: 5, action: zs_progress_action::ZS_STOP };
    let user_data = (&raw mut log).cast();
    let options = zs_refine_options { steps: 100, progress: Some(listen), user_data, ..Versioned::new() };
    let (scene, info) = made(place.in_c(&options));
    let expected = place.in_rust(&RefineOptions { length: RefineLength::Steps(100), ..RefineOptions::default() }, 5);
    assert_same("scene", &bits(&scene), &bits(&expected.scene));
    assert_eq!((info.stop_reason, info.steps, log.steps.len()), (zs_stop_reason::ZS_STOP_REASON_STOPPED as i32, 5, 5));
    assert!(info.best_psnr.is_nan() && log.steps.iter().all(|now| now.psnr.is_nan()));
}

#[test]
fn a_refinement_that_is_canceled_hands_out_nothing() {
    let mut log = CallLog { steps: Vec::new(), stop_after: 2, action: zs_progress_action::ZS_CANCEL };
    let user_data = (&raw mut log).cast();
    let options = zs_refine_options { progress: Some(listen), user_data, ..Versioned::new() };
    assert_eq!(place(3).in_c(&options).map(drop), Err(ZS_ERROR_CANCELLED));
    assert_eq!(log.steps.len(), 2);
}

#[test]
fn a_time_sets_the_steps() {
    let place = place(3);
    let (scene, info) = made(place.in_c(&zs_refine_options { steps: 9, seconds: 1e-9, ..Versioned::new() }));
    assert_eq!((info.stop_reason, info.steps), (zs_stop_reason::ZS_STOP_REASON_FINISHED as i32, 1));
    let expected =
        place.in_rust(&RefineOptions { length: RefineLength::Steps(1), ..RefineOptions::default() }, usize::MAX);
    assert_same("scene", &bits(&scene), &bits(&expected.scene));
}

#[test]
fn cameras_and_exposures_are_optimized_and_gaussians_grow_as_in_rust() {
    let mut place = place(3);
    place.cameras[1].pose.translation.x += 0.01;
    let expected = place.in_rust(
        &RefineOptions {
            length: RefineLength::Steps(60),
            optimize_cameras: true,
            exposure: Exposure::On,
            max_gaussians: Some(70),
            ..RefineOptions::default()
        },
        usize::MAX,
    );
    let exposure = zs_exposure_mode::ZS_EXPOSURE_ON as i32;
    let options = zs_refine_options { steps: 60, optimize_cameras: 1, exposure, max_gaussians: 70, ..Versioned::new() };
    let (device, scene) = (open_device(), scene_of(&place.moved));
    let images: Vec<_> = place.photos.iter().map(image_of).collect();
    let (cameras, mut refined) = (place.c_cameras(), [zs_camera::new(); 3]);
    let mut exposures = [f32::NAN; 36];
    let (to_cameras, to_exposures) = (refined.as_mut_ptr(), exposures.as_mut_ptr());
    let mut result = zs_refine_result { cameras: to_cameras, exposures: to_exposures, ..Versioned::new() };
    let (images, cameras, result) = (images.as_ptr(), cameras.as_ptr(), &mut result);
    let refine =
        |out| unsafe { zs_refine_scene(device.handle, scene.handle, images, cameras, 3, &options, result, out) };
    let found = Object::new(refine);
    assert_same("scene", &bits(&read(&found)), &bits(&expected.scene));
    for (found, expected) in refined.iter().zip(&expected.cameras) {
        assert_eq!(found.translation, expected.pose.translation.to_array());
        assert_eq!(found.rotation, expected.pose.rotation.transpose().to_cols_array());
    }
    assert_ne!(refined[1].translation, place.cameras[1].pose.translation.to_array());
    let learned = expected.exposures.expect("exposures");
    assert_eq!(exposures.to_vec(), learned.iter().flat_map(|learned| learned.0.concat()).collect::<Vec<_>>());
}

#[test]
fn what_cannot_be_refined_is_refused() {
    let place = place(2);
    let (device, scene) = (open_device(), scene_of(&place.moved));
    let (images, cameras): (Vec<_>, _) = (place.photos.iter().map(image_of).collect(), place.c_cameras());
    let call = |images: *const zs_image, cameras: *const zs_camera, count, options: *const _, info| {
        let mut refined = dangling_mut();
        // SAFETY: live objects; arrays of their lengths, or counts rejected before access.
        let status = unsafe {
            zs_refine_scene(device.handle, scene.handle, images, cameras, count, options, info, &mut refined)
        };
        assert!(refined.is_null());
        status
    };
    let refused = |options: zs_refine_options, words: &[&str]| {
        let status = call(images.as_ptr(), cameras.as_ptr(), 2, &options, null_mut());
        fails(status, ZS_ERROR_ARGUMENT, words);
    };
    refused(zs_refine_options { optimize_cameras: 2, ..Versioned::new() }, &["optimize_cameras", "0 or 1"]);
    refused(zs_refine_options { seconds: -1.0, ..Versioned::new() }, &["seconds", "-1"]);
    refused(zs_refine_options { seconds: f64::NAN, ..Versioned::new() }, &["seconds", "NaN"]);
    refused(zs_refine_options { perceptual_weight: f32::NAN, ..Versioned::new() }, &["perceptual_weight"]);
    refused(zs_refine_options { holdout_views: -2, ..Versioned::new() }, &["holdout_views", "-2"]);
    refused(zs_refine_options { holdout_views: 2, ..Versioned::new() }, &["held-out photos", "fewer than the 2"]);
    for struct_size in [0, 4, 47, 1000] {
        refused(zs_refine_options { struct_size, ..Versioned::new() }, &["zs_refine_options, struct_size"]);
    }
    let (photos, poses) = (images.as_ptr(), cameras.as_ptr());
    let argument = |status, words: &[&str]| fails(status, ZS_ERROR_ARGUMENT, words);
    argument(call(photos, poses, 0, null(), null_mut()), &["number of images"]);
    argument(call(null(), poses, 2, null(), null_mut()), &["images", "NULL"]);
    argument(call(photos, null(), 2, null(), null_mut()), &["cameras", "NULL"]);
    argument(call(photos, poses, usize::MAX, null(), null_mut()), &["number of images"]);
    let wrong = [cameras[0], zs_camera { fx: f64::NAN, ..cameras[1] }];
    argument(call(photos, wrong.as_ptr(), 2, null(), null_mut()), &["camera 1"]);
    let larger = [cameras[0], zs_camera { width: 480, ..cameras[1] }];
    argument(call(photos, larger.as_ptr(), 2, null(), null_mut()), &["camera 1"]);
    let mut info = zs_refine_result { struct_size: 12, ..zs_refine_result::new() };
    argument(call(photos, poses, 2, null(), &mut info), &["zs_refine_result, struct_size"]);
    assert_eq!(info.struct_size, 12);
    let nulls = unsafe {
        let empty = scene_of(&Scene::default());
        let mut out = null_mut();
        [
            zs_refine_scene(null(), scene.handle, photos, poses, 2, null(), null_mut(), &mut out),
            zs_refine_scene(device.handle, null(), photos, poses, 2, null(), null_mut(), &mut out),
            zs_refine_scene(device.handle, scene.handle, photos, poses, 2, null(), null_mut(), null_mut()),
            zs_refine_scene(device.handle, empty.handle, photos, poses, 2, null(), null_mut(), &mut out),
        ]
    };
    assert_eq!(nulls, [ZS_ERROR_ARGUMENT; 4]);
}

#[test]
fn refine_in_c() {
    let mut place = place(4);
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name);
    write_ply(&place.moved, path("scene.ply")).expect("a scene can be written");
    // Files store log scales.
    place.moved = read_ply(path("scene.ply")).expect("a scene");
    let mut cameras = String::new();
    for camera in &place.cameras {
        let (i, pose) = (&camera.intrinsics, &camera.pose);
        let numbers = [i.fx, i.fy, i.cx, i.cy].into_iter().chain(pose.rotation.transpose().to_cols_array());
        let numbers: Vec<_> = numbers.chain(pose.translation.to_array()).map(|number| number.to_string()).collect();
        let _ = writeln!(cameras, "{}", numbers.join(" "));
    }
    std::fs::write(path("cameras.txt"), cameras).expect("a file can be written");
    let names: Vec<_> = (0..4).map(|i| path(&format!("{i}.png"))).collect();
    for (photo, name) in place.photos.iter().zip(&names) {
        photo.save_png(name).expect("a photo can be written");
    }
    let program = installation().compile(&root().join("engine/examples/refine.c"), Linking::Shared, &[]);
    let mut command = runner(&program);
    command.args([path("scene.ply"), path("cameras.txt"), path("sharp.ply")]).args(&names);
    let out = success(command);
    let refined = read_ply(path("sharp.ply")).expect("a scene");
    let request = RefineOptions { length: RefineLength::Steps(100), ..RefineOptions::default() };
    let expected = place.in_rust(&request, usize::MAX);
    assert_same("means", refined.means.as_flattened(), expected.scene.means.as_flattened());
    assert!(out.contains("loss 0.") && out.contains("100 steps"), "{out}");
    std::fs::write(path("micro.safetensors"), micro()).expect("a file can be written");
    let mut command = runner(&program);
    command.args([path("micro.safetensors"), path("cameras.txt"), path("tokens.ply")]).args(&names);
    assert!(success(command).contains("100 steps"));
    assert!(read_ply(path("tokens.ply")).is_ok_and(|scene| !scene.is_empty()));
}
