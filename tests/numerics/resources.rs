//! Full disks, killed and concurrent processes, memory growth.

use crate::{micro, noise, reconstruct};
use std::time::Duration;
use zipsplat_tests::{prelude::*, processes::resident_bytes};

fn scene_files() -> Vec<String> {
    scenes::scene_extensions().map(|extension| format!("scene.{extension}")).collect()
}

fn write_all(folder: &Path, scene: &Scene, picture: &Image, weights: &Checkpoint) -> Vec<Result<(), Error>> {
    let mut results: Vec<_> = scene_files().iter().map(|name| scene.save(folder.join(name))).collect();
    results.push(picture.save_png(folder.join("picture.png")));
    results.push(weights.save(folder.join("weights.safetensors"), Dtype::F32));
    results
}

fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut paths: Vec<PathBuf> = folder.read_dir().unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths.into_iter().map(|path| (path.clone(), std::fs::read(path).unwrap())).collect()
}

#[test]
fn a_full_disk_leaves_what_was_there() {
    let folder = tempfile::tempdir().unwrap();
    let small = Checkpoint::seeded_architecture(architectures::golden("micro"), "other").unwrap();
    for result in write_all(folder.path(), &random_scene(5, 0, 0.1), &noise(4, 4, 1), &small) {
        result.unwrap();
    }
    let before = contents(folder.path());
    assert_eq!(before.len(), scene_files().len() + 2);
    // Further writes return errors instead of a signal.
    assert_succeeds(child("resources::writes_to_a_full_disk", folder.path(), "trap '' XFSZ; ulimit -f 16"));
    assert!(contents(folder.path()) == before, "a file changed, or a part of one was left");
}

#[test]
#[ignore = "child of a_full_disk_leaves_what_was_there"]
fn writes_to_a_full_disk() {
    let Some(folder) = target() else { return };
    for (i, result) in
        write_all(&folder, &random_scene(3_000, 3, 0.1), &noise(200, 200, 2), &micro()).iter().enumerate()
    {
        assert!(matches!(result, Err(Error::Io { .. })), "file {i}: {result:?}");
    }
}

#[test]
fn a_device_without_space_is_an_error() {
    let error = zipsplat::types::write_ply(&random_scene(3_000, 3, 0.1), "/dev/full").unwrap_err();
    assert!(matches!(&error, Error::Io { path, .. } if path == Path::new("/dev/full")), "{error}");
}

#[test]
fn a_killed_writer_leaves_a_whole_file() {
    let folder = tempfile::tempdir().unwrap();
    let (sizes, files) = ([1_000, 2_000], scene_files());
    for name in &files {
        random_scene(sizes[0], 0, 0.1).save(folder.path().join(name)).unwrap();
    }
    let last_written =
        || folder.path().join(&files[files.len() - 1]).metadata().and_then(|found| found.modified()).unwrap();
    for delay in [1, 7, 19, 31] {
        let before = last_written();
        let mut writer = child("resources::writes_forever", folder.path(), "").spawn().unwrap();
        while last_written() == before {
            assert_eq!(writer.try_wait().unwrap(), None, "the writer ended by itself");
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(delay));
        writer.kill().unwrap();
        writer.wait().unwrap();
        for name in &files {
            let scene = Scene::open(folder.path().join(name)).unwrap_or_else(|error| panic!("{error}"));
            assert!(sizes.contains(&scene.len()), "{name}: {} Gaussians", scene.len());
        }
    }
}

#[test]
#[ignore = "child of a_killed_writer_leaves_a_whole_file"]
fn writes_forever() {
    let Some(folder) = target() else { return };
    let (scenes, files) = ([1_000, 2_000].map(|count| random_scene(count, 0, 0.1)), scene_files());
    for i in 0.. {
        for name in &files {
            (scenes[i % 2]).save(folder.join(name)).unwrap();
        }
    }
}

fn reconstructed(ratios: &[f64]) -> Vec<u8> {
    let device = Device::open(&DeviceOptions::default()).unwrap();
    let model = Model::from_checkpoint(&device, &micro(), |_| ControlFlow::Continue(())).unwrap();
    let scene_at = |&ratio| {
        let request = ReconstructOptions { ratio: Ratio::Fixed(ratio), ..ReconstructOptions::default() };
        reconstruct(&model, &[noise(84, 84, 1), noise(84, 84, 2)], &request).to_scene().unwrap()
    };
    ratios.iter().flat_map(|ratio| packed(&scene_at(ratio))).flat_map(f32::to_le_bytes).collect()
}

#[test]
fn two_processes_on_one_device_get_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let files = ["first", "second"].map(|name| folder.path().join(name));
    let children = files.clone().map(|file| child("resources::reconstructs", &file, "").spawn().unwrap());
    let own = reconstructed(&[0.5]);
    for child in children {
        let out = child.wait_with_output().unwrap();
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    }
    for file in files {
        assert!(std::fs::read(&file).unwrap() == own, "{} differs", file.display());
    }
}

#[test]
#[ignore = "child of two_processes_on_one_device_get_the_same"]
fn reconstructs() {
    let Some(file) = target() else { return };
    std::fs::write(file, reconstructed(&[0.5])).unwrap();
}

#[test]
fn reconstructions_in_a_row_do_not_grow() {
    assert_succeeds(child("resources::reconstructs_and_renders_again_and_again", Path::new("25"), ""));
}

#[test]
#[ignore = "a minute on a CPU"]
fn a_thousand_reconstructions_do_not_grow() {
    assert_succeeds(child("resources::reconstructs_and_renders_again_and_again", Path::new("1000"), ""));
}

#[test]
#[ignore = "child of reconstructions_in_a_row_do_not_grow"]
fn reconstructs_and_renders_again_and_again() {
    use zipsplat::stages::render::{RenderOptions, Renderer};
    let Some(rounds) = target().and_then(|text| text.to_str()?.parse::<u64>().ok()) else { return };
    let device = Device::open(&DeviceOptions::default()).unwrap();
    let images = [noise(28, 28, 1), noise(28, 28, 2)];
    let mut early = 0;
    for round in 0..rounds {
        let model = Model::from_checkpoint(&device, &micro(), |_| ControlFlow::Continue(())).unwrap();
        let request = ReconstructOptions { ratio: Ratio::Fixed(0.5), ..ReconstructOptions::default() };
        let scene = reconstruct(&model, &images, &request).to_scene().unwrap();
        let camera = zipsplat_tests::scenes::camera(40 + round as u32 % 3, 30);
        Renderer::new(&device).render_scene(&scene, &[camera], &RenderOptions::default()).unwrap();
        if round == rounds / 2 {
            early = resident_bytes();
        }
    }
    // A round takes a few MiB.
    let grown = resident_bytes().saturating_sub(early);
    assert!(grown < 8 << 20, "{grown} bytes more after the second half of {rounds} rounds");
}

/// Of lavapipe: subgroups of 4, 8 and 16 lanes.
const VECTORS: [u32; 3] = [128, 256, 512];

/// Sums are reordered: each is within the tolerance.
#[test]
fn every_subgroup_size_gives_the_same_scene() {
    if !device().limits().cpu {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let scene_of = |bits: u32| -> Vec<f32> {
        let file = folder.path().join(bits.to_string());
        let shell = format!("export LP_NATIVE_VECTOR_WIDTH={bits}");
        assert_succeeds(child("resources::reconstructs_all_tokens_and_half", &file, &shell));
        let bytes = std::fs::read(file).unwrap();
        bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
    };
    let scenes = VECTORS.map(scene_of);
    assert!(scenes.iter().any(|scene| *scene != scenes[0]), "one subgroup size was tested three times");
    let width = architectures::golden("micro").gaussian_width();
    for (scene, bits) in scenes.iter().zip(VECTORS) {
        let tolerance = |field: &str| Tolerance::of_field(field).times(2.0);
        assert_gaussians_within(&format!("{bits} bits"), scene, &scenes[0], width, tolerance);
    }
}

#[test]
#[ignore = "child of every_subgroup_size_gives_the_same_scene"]
fn reconstructs_all_tokens_and_half() {
    let Some(file) = target() else { return };
    std::fs::write(file, reconstructed(&[1.0, 0.5])).unwrap();
}

#[test]
#[ignore = "half a minute a size on a CPU"]
fn every_subgroup_size_of_lavapipe_stays_within_the_bounds() {
    for bits in VECTORS {
        let shell = format!("export LP_NATIVE_VECTOR_WIDTH={bits}");
        assert_succeeds(child("resources::examines_the_catalog", Path::new("all"), &shell));
    }
}

#[test]
#[ignore = "child of every_subgroup_size_of_lavapipe_stays_within_the_bounds"]
fn examines_the_catalog() {
    if target().is_some() {
        zipsplat_tests::catalog::examine("");
    }
}
