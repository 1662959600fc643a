//! Estimated cameras through C.

use crate::{
    calls::*,
    header::root,
    installation::{Linking, installation, runner, success},
};
use std::{
    ops::ControlFlow,
    ptr::{null, null_mut},
};
use zipsplat::reconstruct::{Model, ReconstructOptions};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{device::device as rust_device, scenes::random_scene};

#[test]
fn cameras_are_those_of_rust() {
    let photos = photos(3);
    let images: Vec<zs_image> = photos.iter().map(image_of).collect();
    let device = open_device();
    let scene = reconstruct(&model(&device), &images, &reconstruct_options());
    let (mut cameras, mut inliers, mut patches) = ([zs_camera::new(); 3], [9; 3], [9; 3]);
    let rust = Model::from_checkpoint(rust_device(), &checkpoint(), |_| ControlFlow::Continue(())).expect("a model");
    let made = rust
        .reconstruct_views(&photos, &ReconstructOptions::default(), |_| ControlFlow::Continue(()))
        .expect("a scene");
    let found = made.cameras(&made.to_scene().expect("Gaussians"), None).expect("its own scene");
    assert!(found.iter().any(Result::is_ok), "{found:?}");
    // SAFETY: a live scene, and one array element per photo.
    let status =
        unsafe { zs_scene_cameras(scene.handle, cameras.as_mut_ptr(), inliers.as_mut_ptr(), patches.as_mut_ptr(), 3) };
    ok(status);
    for (i, found) in found.iter().enumerate() {
        let Ok(found) = found else {
            assert_eq!((cameras[i].width, inliers[i], patches[i]), (0, 0, 0));
            continue;
        };
        assert_eq!((inliers[i] as usize, patches[i] as usize), (found.inliers, found.pairs));
        let (lens, pose) = (found.camera.intrinsics, found.camera.pose);
        assert_eq!((cameras[i].width, cameras[i].height, cameras[i].fx, cameras[i].cy), (SIDE, SIDE, lens.fx, lens.cy));
        assert_eq!(cameras[i].rotation, pose.rotation.transpose().to_cols_array());
        assert_eq!(cameras[i].translation, pose.translation.to_array());
    }
    // SAFETY: as above.
    unsafe {
        ok(zs_scene_cameras(scene.handle, cameras.as_mut_ptr(), null_mut(), null_mut(), 3));
        let refused = |cameras, count, words: &[&str]| {
            fails(zs_scene_cameras(scene.handle, cameras, null_mut(), null_mut(), count), ZS_ERROR_ARGUMENT, words);
        };
        refused(cameras.as_mut_ptr(), 2, &["number of cameras", "found 2", "3, one a photo"]);
        refused(null_mut(), 3, &["cameras", "NULL"]);
        cameras[1].struct_size = 12;
        refused(cameras.as_mut_ptr(), 3, &["zs_camera", "struct_size"]);
        let none = zs_scene_cameras(null(), cameras.as_mut_ptr(), null_mut(), null_mut(), 3);
        fails(none, ZS_ERROR_ARGUMENT, &["scene", "NULL"]);
    }
}

#[test]
fn scenes_of_files_have_no_photos() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.ply");
    zipsplat::types::write_ply(&random_scene(20, 0, 0.1), &path).expect("a scene can be written");
    let path = std::ffi::CString::new(path.to_str().expect("UTF-8")).expect("no NUL");
    // SAFETY: a path, an output pointer.
    let scene = Object::new(zs_scene_destroy, |out| unsafe { zs_scene_open(path.as_ptr(), out) });
    let mut camera = zs_camera::new();
    // SAFETY: a live scene, and one camera.
    let status = unsafe { zs_scene_cameras(scene.handle, &mut camera, null_mut(), null_mut(), 1) };
    fails(status, ZS_ERROR_ARGUMENT, &["scene to find cameras of", "without cameras"]);
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
