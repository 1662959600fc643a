use crate::{
    calls::*,
    header::root,
    installation::{Linking, installation, runner, success},
    same_bits::rust_camera,
};
use std::ops::ControlFlow;
use zipsplat::SceneFrame;
use zipsplat::reconstruct::{BlockOptions, Model, ReconstructOptions};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::device::device as rust_device;

#[test]
fn cameras_are_those_of_rust() {
    let photos = photos(3);
    let images: Vec<zs_image> = photos.iter().map(image_of).collect();
    let device = open_device();
    let reconstruction = made(try_reconstruct(&model(&device), &images, &reconstruct_options()));
    let rust = Model::from_checkpoint(rust_device(), &checkpoint(), |_| ControlFlow::Continue(())).expect("a model");
    let expected = rust
        .reconstruct_views(&photos, &ReconstructOptions::default(), |_| ControlFlow::Continue(()))
        .expect("a scene");
    let found = expected.cameras(&expected.to_scene().expect("Gaussians"), None).expect("its own scene");
    assert!(found.iter().any(Result::is_ok), "{found:?}");
    let mut estimate = zs_camera_estimate::new();
    for (i, found) in found.iter().enumerate() {
        let camera = unsafe {
            ok(zs_reconstruction_estimate_camera(reconstruction.handle, i, &mut estimate));
            estimate.camera.as_ref()
        };
        let Ok(found) = found else {
            assert!(camera.is_none() && (estimate.inliers, estimate.patches) == (0, 0));
            continue;
        };
        let camera = camera.expect("the estimate's");
        assert_eq!((estimate.inliers as usize, estimate.patches as usize), (found.inliers, found.pairs));
        let (lens, pose) = (found.camera.intrinsics, found.camera.pose);
        assert_eq!((camera.width, camera.height, camera.fx, camera.cy), (SIDE, SIDE, lens.fx, lens.cy));
        assert_eq!(camera.rotation, pose.rotation.transpose().to_cols_array());
        assert_eq!(camera.translation, pose.translation.to_array());
    }
    let mut info = zs_reconstruction_info::new();
    unsafe {
        ok(zs_reconstruction_get_info(reconstruction.handle, &mut info));
        let status = zs_reconstruction_estimate_camera(reconstruction.handle, 3, &mut estimate);
        fails(status, ZS_ERROR_ARGUMENT, &["number of a photo", "below 3"]);
        estimate.struct_size = 12;
        let status = zs_reconstruction_estimate_camera(reconstruction.handle, 0, &mut estimate);
        fails(status, ZS_ERROR_ARGUMENT, &["zs_camera_estimate", "struct_size"]);
    }
    assert_eq!(
        (info.view_count, info.token_count, info.gaussian_count),
        (3, expected.tokens, expected.gaussians.len())
    );
    let mask: Vec<u8> = (0..SIDE * SIDE).map(|at| u8::from(at % SIDE < SIDE / 2)).collect();
    let masked: Vec<_> = images.iter().map(|image| zs_image { mask: mask.as_ptr(), ..*image }).collect();
    let reconstruction = made(try_reconstruct(&model(&device), &masked, &reconstruct_options()));
    ok(unsafe { zs_reconstruction_get_info(reconstruction.handle, &mut info) });
    let (count, each) = (read(&to_scene(&reconstruction)).len(), expected.gaussians.len() / expected.tokens);
    assert!(info.gaussian_count == count && info.token_count * each == count && info.token_count < expected.tokens);
}

#[test]
fn known_cameras_are_not_estimated_and_an_estimated_scale_is_a_warning() {
    let (device, photos) = (open_device(), photos(2));
    let images: Vec<zs_image> = photos.iter().map(image_of).collect();
    let cameras = [camera(SIDE, SIDE, 0.0), camera(SIDE, SIDE, 0.5)];
    let posed = zs_reconstruct_options {
        cameras: cameras.as_ptr(),
        camera_count: 2,
        input_size: [SIDE; 2],
        ..Versioned::new()
    };
    let reconstruction = made(try_reconstruct(&model(&device), &images, &posed));
    let (mut estimate, mut info) = (zs_camera_estimate::new(), zs_reconstruction_info::new());
    let warnings = unsafe {
        let status = zs_reconstruction_estimate_camera(reconstruction.handle, 0, &mut estimate);
        fails(status, ZS_ERROR_ARGUMENT, &["camera"]);
        ok(zs_reconstruction_get_info(reconstruction.handle, &mut info));
        std::ffi::CStr::from_ptr(info.warnings).to_str().expect("UTF-8")
    };
    assert!(warnings.starts_with("no point cloud: scene scale 0.") && warnings.lines().count() == 1, "{warnings}");
}

#[test]
fn photos_become_a_scene_in_blocks() {
    let (device, photos) = (open_device(), photos(3));
    let (model, images) = (model(&device), photos.iter().map(image_of).collect::<Vec<_>>());
    let cameras = [0.0, 0.1, 0.2].map(|x| camera(SIDE, SIDE, x));
    let whole =
        zs_reconstruct_options { cameras: cameras.as_ptr(), camera_count: cameras.len(), ..reconstruct_options() };
    let blocks = zs_reconstruct_options { block_size: 2, block_overlap: 1, ..whole };
    let [one, joined] =
        [&whole, &blocks].map(|options| read(&to_scene(&made(try_reconstruct(&model, &images, options)))));
    assert!(joined.len() == one.len() && bits(&joined) != bits(&one), "{} and {}", joined.len(), one.len());
    let rust = Model::from_checkpoint(rust_device(), &checkpoint(), |_| ControlFlow::Continue(())).expect("a model");
    let options = ReconstructOptions {
        cameras: Some(cameras.iter().map(rust_camera).collect()),
        scene_scale: Some(1.0),
        input_size: Some([SIDE; 2]),
        world: Some(SceneFrame::FirstCamera),
        blocks: BlockOptions { size: Some(2), overlap: Some(1) },
        ..ReconstructOptions::default()
    };
    let expected = rust.reconstruct(&photos, &options, |_| ControlFlow::Continue(())).expect("a scene");
    assert_eq!((expected.seams.len(), bits(&joined)), (1, bits(&expected.to_scene().expect("Gaussians"))));
    for (options, words) in [
        (zs_reconstruct_options { keep_features: 1, ..blocks }, ["keep_features", "2 blocks"]),
        (zs_reconstruct_options { block_overlap: 2, ..blocks }, ["block overlap", "found 2"]),
        (zs_reconstruct_options { block_size: 193, ..blocks }, ["block size", "1 to 192"]),
        (zs_reconstruct_options { kv_pool: c"5".as_ptr(), ..blocks }, ["kv_pool: found 5", "local/2"]),
    ] {
        refused(try_reconstruct(&model, &images, &options), ZS_ERROR_ARGUMENT, &words);
    }
}

/// The refinement example can read the cameras of this one.
#[test]
fn cameras_in_c() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("micro.safetensors"), micro()).expect("weights can be written");
    let names = ["0.png", "1.png"].map(at);
    photos(2).iter().zip(&names).for_each(|(photo, name)| photo.save_png(name).expect("a photo can be written"));
    let example = |name: &str| root().join("engine/examples").join(name);
    let cameras = installation().compile(&example("cameras.c"), Linking::Shared, &[]);
    let mut command = runner(&cameras);
    command.arg(at("micro.safetensors")).args([at("scene.ply"), at("cameras.txt")]).args(&names);
    let out = success(command);
    assert_eq!(out.lines().filter(|line| line.contains("patches agree")).count(), 2, "{out}");
    let numbers = std::fs::read_to_string(at("cameras.txt")).expect("cameras");
    assert!(numbers.lines().all(|line| line.split(' ').filter(|word| word.parse::<f64>().is_ok()).count() == 16));
    assert_eq!(numbers.lines().count(), 2, "{numbers}");
}
