use crate::{
    calls::{micro, photos, rust_scene},
    header::root,
    installation::{Linking, installation, runner, success},
};
use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    process::Command,
};
use tempfile::TempDir;
use zipsplat::{
    depth::{DepthModel, DepthOptions},
    ops::Arithmetic,
    reconstruct::ReconstructOptions,
    types::{Fitting, Image, bounded_views, preprocess::fit, read_ply},
    weights::{Checkpoint, DepthCheckpoint, DepthHeads, Dtype},
};
use zipsplat_tests::{
    architectures, compare::assert_same, device::device as rust_device, processes::python_with_numpy,
};

fn example(name: &str) -> PathBuf {
    root().join("engine/examples").join(name)
}

fn inputs() -> (TempDir, Vec<PathBuf>) {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("micro.safetensors"), micro()).expect("weights can be written");
    let names = ["0.png", "1.png"].map(|name| folder.path().join(name));
    for (photo, name) in photos(2).iter().zip(&names) {
        photo.save_png(name).expect("a photo can be written");
    }
    (folder, names.to_vec())
}

fn expected_means(checkpoint: &Checkpoint, photos: &[PathBuf]) -> Vec<[f32; 3]> {
    let side = checkpoint.image_size();
    let view = |path: &PathBuf| fit(&Image::open(path).expect("a photo"), side, side).expect("a view").image;
    let images: Vec<_> = photos.iter().map(view).collect();
    rust_scene(checkpoint, &images, &ReconstructOptions::default()).means
}

fn assert_reconstructs(example: impl Fn() -> Command, message: impl Fn(usize) -> String) {
    let (folder, photos) = inputs();
    let micro = folder.path().join("micro.safetensors");
    let checkpoints = [
        (micro.clone(), Checkpoint::open(&micro, None).expect("a network")),
        ("builtin".into(), Checkpoint::builtin().expect("a model")),
    ];
    for (model, checkpoint) in checkpoints {
        let [scene, picture] = ["scene.ply", "picture.png"].map(|name| folder.path().join(name));
        let mut command = example();
        command.arg(&model).args([&scene, &picture]).args(&photos);
        let out = success(command);
        let (means, expected) = (read_ply(&scene).expect("a scene").means, expected_means(&checkpoint, &photos));
        assert_same(&format!("means, {}", model.display()), means.as_flattened(), expected.as_flattened());
        assert!(out.contains(&message(means.len())), "{out}");
        let picture = Image::open(&picture).expect("a picture");
        assert!((picture.width, picture.height) == (256, 256) && picture.rgb.iter().any(|byte| *byte > 0));
    }
}

#[test]
fn reconstruct_in_c() {
    let source = example("reconstruct.c");
    let lines = std::fs::read_to_string(&source).expect("the example").lines().count();
    assert!(lines < 80, "{lines} lines");
    for linking in [Linking::Shared, Linking::Static] {
        let program = installation().compile(&source, linking, &[]);
        assert_reconstructs(|| runner(&program), |_| String::new());
    }
}

#[test]
fn reconstruct_in_cpp() {
    let program = installation().compile(&example("reconstruct.cpp"), Linking::Shared, &[]);
    assert_reconstructs(|| runner(&program), |count| format!("{count} Gaussians"));
}

#[test]
fn reconstruct_in_python() {
    let python = python_with_numpy();
    let run = || {
        let mut command = runner(&python);
        command.arg(example("reconstruct.py"));
        command.env("ZIPSPLAT_LIBRARY", installation().prefix.join("lib/libzipsplat.so"));
        command
    };
    assert_reconstructs(run, |count| format!("({count}, 3)"));
}

#[test]
fn reconstruct_in_c_leaks_nothing_and_touches_nothing_invalid() {
    let (folder, photos) = inputs();
    let program = installation().compile(&example("reconstruct.c"), Linking::Sanitized, &[]);
    let [model, scene, picture] =
        ["micro.safetensors", "scene.ply", "picture.png"].map(|name| folder.path().join(name));
    // The validation layer leaks.
    let run = |model: &Path| {
        let mut command = runner(&program);
        command.arg(model).args([&scene, &picture]).args(&photos).env("ZIPSPLAT_VALIDATION", "0");
        command
    };
    success(run(&model));
    assert_names_the_error(run(&folder.path().join("none")));
}

#[track_caller]
fn assert_names_the_error(mut command: Command) {
    let failed = command.output().expect("the program runs");
    let message = String::from_utf8_lossy(&failed.stderr);
    assert!(message.starts_with("ZS_ERROR_IO: ") && message.lines().count() == 1, "{message}");
}

fn portable_float_map(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).expect("a picture of floats");
    let text: Vec<&[u8]> = bytes.splitn(4, |byte| *byte == b'\n').collect();
    let size = std::str::from_utf8(text[1]).expect("a size");
    let width: usize = size.split(' ').next().and_then(|width| width.parse().ok()).expect("a width");
    assert_eq!((text[0], text[2]), (&b"Pf"[..], &b"-1"[..]));
    let values: Vec<f32> = text[3].as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    values.rchunks(width).flatten().copied().collect()
}

#[test]
fn depth_in_c() {
    let (folder, photos) = inputs();
    let weights = folder.path().join("da3.safetensors");
    let network = DepthCheckpoint::seeded(architectures::depth_micro(), "micro").expect("a network");
    network.save_with(&weights, Dtype::F32, |_| ControlFlow::Continue(())).expect("weights can be written");
    let program = installation().compile(&example("depth.c"), Linking::Shared, &[]);
    let prefix = folder.path().join("out-");
    let run = |weights: &Path| {
        let mut command = runner(&program);
        command.arg(weights).arg(&prefix).args(&photos);
        command
    };
    let out = success(run(&weights));
    assert_eq!(out.lines().filter(|line| line.contains("in the middle, confidence")).count(), 2, "{out}");

    let read: Vec<Image> = photos.iter().map(|path| Image::open(path).expect("a photo")).collect();
    let views = bounded_views(read.len(), |i| Ok(&read[i]), Fitting::LongestSide, None).expect("views");
    let images: Vec<Image> = views.iter().map(|view| view.image.clone()).collect();
    let checkpoint = DepthCheckpoint::open(&weights, DepthHeads::default()).expect("weights");
    let model =
        DepthModel::from_checkpoint(rust_device(), &checkpoint, Arithmetic::EXACT, |_| ControlFlow::Continue(()));
    let truth = model.expect("a model").predict(&images, &DepthOptions::default(), |_| ControlFlow::Continue(()));
    for (i, view) in truth.expect("depth").views.iter().enumerate() {
        let found = portable_float_map(&folder.path().join(format!("out-{i}.pfm")));
        assert_same(&format!("depth of photo {i}"), &found, &view.depth);
    }
    let cameras = std::fs::read_to_string(folder.path().join("out-cameras.txt")).expect("cameras");
    assert!(cameras.lines().count() == 2 && cameras.lines().all(|line| line.split(' ').count() == 16), "{cameras}");
    assert_names_the_error(run(&folder.path().join("none")));
}

#[test]
fn app_with_its_own_device() {
    let vulkan = installation().pkg_config(&["--cflags", "--libs", "vulkan"]);
    let more: Vec<&str> = vulkan.iter().map(String::as_str).chain(["-lpthread"]).collect();
    let program = installation().compile(&example("app_device.c"), Linking::Shared, &more);
    let mut command = runner(&program);
    command.env("VK_LAYER_SETTINGS_PATH", root().join("tests/vk_layer_settings.txt"));
    let out = success(command);
    assert!(out.contains("image, buffer and memory agree, 0 messages"), "{out}");
}
