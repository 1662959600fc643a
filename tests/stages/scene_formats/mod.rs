mod antialiased;
mod foreign;
mod gltf;
mod packed;
mod plyfile;
mod sog;
mod spz4;

use flate2::Compression;
use zipsplat::types::{Origin, SaveOptions, SceneFormat, World, decode_world, read_world};
use zipsplat_tests::prelude::*;

/// Rotations of every largest component, sign and length; opaque and transparent Gaussians.
fn scene(sh_degree: u32) -> Scene {
    let mut scene = scenes::random_scene(400, sh_degree, 0.1);
    for (i, quat) in scene.quats.iter_mut().enumerate() {
        quat.rotate_right(i % 4);
        let sign = if i % 8 < 4 { 1.0 } else { -3.0 };
        *quat = quat.map(|q| sign * q);
    }
    (scene.quats[0], scene.quats[1]) = ([0.0, 0.0, 0.0, -2.0], [0.0, 1.0, -1.0, 0.0]);
    // Squares beyond f32's range.
    (scene.quats[2], scene.quats[3]) = ([1e20, -1e20, 0.0, 0.0], [0.0, 3e-25, 4e-25, 0.0]);
    (scene.opacities[0], scene.opacities[1]) = (0.0, 1.0);
    scene
}

fn round_trip(scene: &Scene, name: &str, options: &SaveOptions) -> Scene {
    let bytes = bytes_of(name, |path| scene.save_with(path, options).unwrap());
    read_as(name, bytes, |path| Scene::open(path).unwrap())
}

#[track_caller]
fn assert_damaged(name: &str, bytes: &[u8], words: &[&str]) {
    assert_malformed(name, bytes, |path| Scene::open(path), words);
}

#[track_caller]
fn assert_within(name: &str, found: &[f32], truth: &[f32], bound: impl Fn(f32) -> f32) {
    assert_eq!(found.len(), truth.len(), "{name}");
    for (i, (found, truth)) in found.iter().zip(truth).enumerate() {
        assert!((found - truth).abs() <= bound(*truth), "{name} {i}: {found}, not {truth}");
    }
}

#[track_caller]
fn assert_rotations(found: &[[f32; 4]], truth: &[[f32; 4]], bound: f64) {
    assert_eq!(found.len(), truth.len());
    for (i, (found, truth)) in found.iter().zip(truth).enumerate() {
        let [found, truth] = [found, truth].map(|quat| matrix_from_quaternion(quat.map(f64::from)));
        assert!(found.abs_diff_eq(truth, bound), "rotation {i}: {found}, not {truth}");
    }
}

fn coefficient(scene: &Scene, k: usize) -> Vec<f32> {
    scene.sh_coeffs.iter().skip(k).step_by(scene.sh_coeffs_per_gaussian()).flatten().copied().collect()
}

/// Half a step of SPZ's grids.
#[track_caller]
fn assert_spz(found: &Scene, truth: &Scene, version: u32, fractional_bits: i32) {
    let slack = 1.0 + 1e-4;
    let position = slack * 0.5 * 2f32.powi(-fractional_bits);
    assert_within("mean", found.means.as_flattened(), truth.means.as_flattened(), |_| position);
    let scale = (slack / 32.0f32).exp() - 1.0;
    assert_within("scale", found.scales.as_flattened(), truth.scales.as_flattened(), |truth| scale * truth);
    assert_within("opacity", &found.opacities, &truth.opacities, |_| slack / 510.0);
    assert_within("color", &coefficient(found, 0), &coefficient(truth, 0), |_| slack / (510.0 * 0.15));
    for k in 1..truth.sh_coeffs_per_gaussian() {
        // Half a level plus half a bucket of 8 or 16 levels.
        let levels = if k < 4 { 4.5 } else { 8.5 };
        assert_within(&format!("sh {k}"), &coefficient(found, k), &coefficient(truth, k), |_| levels / 128.0);
    }
    // A matrix entry has four times a component's error. Version 3: half a step of sqrt(1/2) / 511
    // on three components, and on the largest, at least 1/2. Version 2 derives w: 1/255 on x, y and
    // z becomes up to sqrt(2 * sqrt(3) / 255) at small w.
    assert_rotations(&found.quats, &truth.quats, if version == 2 { 0.5 } else { 0.01 });
}

#[test]
fn spz_keeps_what_its_grids_resolve() {
    for (version, degree) in [(3, 0), (3, 1), (3, 2), (3, 3), (2, 0), (2, 3)] {
        let truth = scene(degree);
        let found = round_trip(&truth, "scene.spz", &SaveOptions { spz_version: version });
        assert_eq!(found.sh_degree, degree);
        assert_spz(&found, &truth, version, 16);
    }
}

#[test]
fn spz_of_many_gaussians_is_one_stream() {
    let truth = scenes::random_scene(120_000, 0, 0.1);
    let [three, four] = [3, 4].map(|spz_version| truth.encode(SceneFormat::Spz, &SaveOptions { spz_version }, None));
    let [three, four] = [three.unwrap(), four.unwrap()];
    assert!(Scene::decode(&three, None).unwrap() == Scene::decode(&four, None).unwrap());
    assert_eq!(gunzip(&three).len(), 16 + 20 * truth.len());
}

#[test]
fn version_2_keeps_rotations_but_near_half_turns() {
    let mut truth = scene(0);
    // For w >= 1/2, its error is at most sqrt(3) times the others'.
    truth.quats.iter_mut().for_each(|quat| quat[0] = 2.0 * quat.iter().fold(0f32, |most, q| most.max(q.abs())));
    let found = round_trip(&truth, "scene.spz", &SaveOptions { spz_version: 2 });
    assert_rotations(&found.quats, &truth.quats, 4.0 * 3f64.sqrt() / 255.0);
}

#[test]
fn spz_gives_far_scenes_coarser_positions() {
    for (reach, fractional_bits) in [(127.0, 16), (130.0, 15), (5000.0, 10), (8e6, 0)] {
        let mut truth = scene(0);
        truth.means[3] = [reach, -reach, 0.3];
        assert_spz(&round_trip(&truth, "scene.spz", &SaveOptions::default()), &truth, 3, fractional_bits);
    }
    let mut far = scene(0);
    far.means[3][1] = -9e6;
    let path = std::env::temp_dir().join("never-written.spz");
    assert_refused(far.save(&path), &["means"]);
    assert!(!path.exists());
    let version = SaveOptions { spz_version: 5 };
    assert!(matches!(scene(0).save_with(&path, &version), Err(Error::Argument { .. })) && !path.exists());
}

#[test]
fn splat_keeps_one_color_most_important_first() {
    let truth = scene(2);
    let found = round_trip(&truth, "scene.splat", &SaveOptions::default());
    let weight = |scene: &Scene, i: usize| scene.scales[i].iter().product::<f32>() * scene.opacities[i];
    assert!((1..found.len()).all(|i| weight(&found, i - 1) >= 0.99 * weight(&found, i) - 1.0 / 255.0));
    let place = |mean: &[f32; 3]| truth.means.iter().position(|truth| truth == mean).expect("a mean of the scene");
    let order: Vec<usize> = found.means.iter().map(place).collect();
    let importance: Vec<f32> = order.iter().map(|&i| weight(&truth, i)).collect();
    assert!(importance.is_sorted_by(|a, b| a >= b) && order.len() == truth.len());
    let pick = |values: &[f32]| order.iter().map(|&i| values[i]).collect::<Vec<f32>>();
    assert_eq!(found.scales, order.iter().map(|&i| truth.scales[i]).collect::<Vec<_>>());
    assert_within("opacity", &found.opacities, &pick(&truth.opacities), |_| 1.001 / 510.0);
    // Half a step of 1/128, or a whole one at 1, stored as 255.
    let quats: Vec<[f32; 4]> = order.iter().map(|&i| truth.quats[i]).collect();
    assert_rotations(&found.quats, &quats, 4.0 / 128.0);
    let (sh_constant, k) = (0.282_094_8, truth.sh_coeffs_per_gaussian());
    let dc: Vec<f32> = order.iter().flat_map(|&i| truth.sh_coeffs[k * i]).collect();
    assert_eq!(found.sh_degree, 0);
    let color = |dc: f32| (0.5 + sh_constant * dc).clamp(0.0, 1.0);
    let colors = |values: &[f32]| values.iter().map(|&dc| color(dc)).collect::<Vec<f32>>();
    assert_within("color", &colors(found.sh_coeffs.as_flattened()), &colors(&dc), |_| 1.001 / 510.0);
}

#[test]
fn empty_scenes_are_scenes() {
    for name in ["scene.ply", "scene.spz", "scene.sog", "scene.splat"] {
        let empty = Scene::default();
        assert_eq!(round_trip(&empty, name, &SaveOptions::default()), empty, "{name}");
    }
}

#[test]
fn formats_are_told_apart() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    scene(0).save(path("a.PLY")).unwrap();
    scene(0).save(path("b.spz")).unwrap();
    fs::rename(path("a.PLY"), path("a.spz")).unwrap();
    fs::rename(path("b.spz"), path("b")).unwrap();
    assert_eq!(SceneFormat::of_file(path("a.spz")).unwrap(), Some(SceneFormat::Ply));
    assert_eq!(SceneFormat::of_file(path("b")).unwrap(), Some(SceneFormat::Spz));
    assert_eq!((Scene::open(path("a.spz")).unwrap().len(), Scene::open(path("b")).unwrap().len()), (400, 400));
    let error = scene(0).save(path("c.obj")).expect_err("no scene's extension");
    assert!(matches!(error, Error::Argument { .. }) && !path("c.obj").exists());
    assert_damaged("c.obj", b"v 0 0 0", &["expected .ply"]);
    assert!(matches!(Scene::open(path("none.spz")), Err(Error::Io { .. })));
}

#[test]
fn bytes_in_memory_are_what_files_have() {
    let folder = tempfile::tempdir().unwrap();
    for format in SceneFormat::ALL.iter().copied() {
        let (truth, path) = (scene(1), folder.path().join(format!("scene{}", format.extension())));
        assert_eq!(SceneFormat::of_extension(&path), Some(format));
        let bytes = truth.encode(format, &SaveOptions::default(), None).unwrap();
        truth.save(&path).unwrap();
        assert!(fs::read(&path).unwrap() == bytes, "{format:?}");
        assert!(Scene::decode(&bytes, Some(format)).unwrap() == Scene::open(&path).unwrap(), "{format:?}");
        let marked = !matches!(format, SceneFormat::Splat | SceneFormat::Sog | SceneFormat::Gltf);
        assert_eq!(Scene::decode(&bytes, None).is_ok(), marked, "{format:?}");
    }
    assert_refused(Scene::decode(b"no scene", None), &["scene in memory", "expected .ply"]);
    let truth = Scene { opacities: vec![2.0; 400], ..scene(0) };
    assert!(matches!(truth.encode(SceneFormat::Ply, &SaveOptions::default(), None), Err(Error::Argument { .. })));
    let row = [f32::NAN, 0.0, 1.0, 0.1, 0.1, 0.1].map(f32::to_le_bytes);
    let bytes = [row.as_flattened(), &[9; 8]].concat();
    assert!(Scene::decode(&bytes, Some(SceneFormat::Splat)).is_err());
    assert_eq!(Scene::decode_unchecked(&bytes, Some(SceneFormat::Splat)).unwrap().len(), 1);
    let outside = br#"{"asset": {"version": "2.0"}, "buffers": [{"uri": "Cargo.toml", "byteLength": 1}]}"#;
    let found = Scene::decode(outside, SceneFormat::named("gltf"));
    assert_refused(found, &["Cargo.toml", "expected a .glb or base64"]);
}

fn spz() -> (Vec<u8>, Vec<u8>) {
    let packed = bytes_of("scene.spz", |path| scene(1).save(path).unwrap());
    let plain = gunzip(&packed);
    (packed, plain)
}

#[test]
fn damaged_spz_are_refused() {
    let (packed, plain) = spz();
    for (at, bytes, reason) in [
        (0, &b"PSGN"[..], "magic"),
        (4, &[4], "version 4"),
        (4, &[1], "version 1"),
        (12, &[4], "degree 4"),
        (13, &[24], "24 fractional bits"),
        (8, &[0xff, 0xff, 0xff, 0xff], "4294967295 Gaussians"),
        (8, &[145, 1], "truncated"),
        (8, &[143, 1], "expected the end"),
    ] {
        let mut changed = plain.clone();
        changed[at..at + bytes.len()].copy_from_slice(bytes);
        assert_damaged("scene.spz", &gzip(&changed, Compression::default()), &[reason, "byte "]);
    }
    for length in [0, 2, 17, packed.len() / 2, packed.len() - 1] {
        assert_damaged("scene.spz", &packed[..length], &[]);
    }
    let mut flipped = packed.clone();
    *flipped.last_mut().unwrap() ^= 1;
    *flipped.iter_mut().rev().nth(6).unwrap() ^= 1;
    assert_damaged("scene.spz", &flipped, &["gzip"]);
    assert_damaged("scene.spz", &plain, &["gzip"]);
}

/// Possible for deflate, not for a scene.
#[test]
fn an_spz_of_more_gaussians_than_its_bytes_hold_is_refused() {
    let (_, plain) = spz();
    let mut bomb = [&plain[..16], &[0; 1 << 20]].concat();
    bomb[8..12].copy_from_slice(&50_000_000u32.to_le_bytes());
    let words = "50000000 Gaussians, which are more than";
    assert_damaged("scene.spz", &gzip(&bomb, Compression::none()), &[words]);
    let mut alike = scenes::random_scene(1, 0, 0.1);
    for _ in 0..18 {
        alike = Scene {
            means: alike.means.repeat(2),
            scales: alike.scales.repeat(2),
            quats: alike.quats.repeat(2),
            opacities: alike.opacities.repeat(2),
            sh_coeffs: alike.sh_coeffs.repeat(2),
            ..Scene::default()
        };
    }
    assert_eq!(round_trip(&alike, "scene.spz", &SaveOptions::default()).len(), 1 << 18);
}

#[test]
fn records_after_an_spz_are_read_over_but_for_other_axes() {
    let (_, mut plain) = spz();
    plain[14] |= 2;
    let extended = |records: &[u8]| gzip(&[&plain[..], records].concat(), Compression::default());
    let axes = |axes: u32| [0xadbe_0003, 4, axes].map(u32::to_le_bytes).concat();
    let opened = |path: &Path| Scene::open(path).unwrap();
    let usual = [vec![0; 24], axes(4)].concat();
    assert_eq!(read_as("scene.spz", extended(&usual), opened), read_as("scene.spz", extended(&[]), opened));
    let at = format!("byte {}: found axes of number 6, expected 4", plain.len() + 8);
    assert_damaged("scene.spz", &extended(&axes(6)), &[&at]);
    assert_damaged("scene.spz", &extended(&[0; 20]), &["expected a whole record"]);
    assert_damaged("scene.spz", &extended(&vec![0; 100 << 20]), &["expected the end"]);
}

#[test]
fn damaged_splats_are_refused() {
    let row = |mean: f32, scale: f32, rotation: u8| {
        let floats = [mean, 0.0, 1.0, 0.1, 0.1, scale].map(f32::to_le_bytes);
        [floats.as_flattened(), &[9; 4], &[rotation; 4]].concat()
    };
    let good = row(1.0, 0.1, 0);
    for (bad, what) in [(row(f32::NAN, 0.1, 0), "means"), (row(1.0, -0.1, 0), "scales"), (row(1.0, 0.1, 128), "quats")]
    {
        assert_damaged("scene.splat", &[&good[..], &bad].concat(), &[what, "1 of 2", "the first is 1"]);
    }
    assert_damaged("scene.splat", &good[..31], &["31 bytes remain"]);
}

#[test]
fn files_say_which_world_a_scene_is_in() {
    let pose = Pose { rotation: matrix_from_quaternion([0.3, -0.5, 0.1, 0.8]), translation: [1e6, -0.1, 3.0].into() };
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.ply", "a.spz", "a.glb", "a.gltf", "a.splat"] {
        let path = folder.path().join(name);
        let format = SceneFormat::of_extension(&path).unwrap();
        let saved = |world: Option<&World>| {
            scene(1).save_in(&path, &SaveOptions::default(), world).unwrap();
            let found = read_world(&path).unwrap();
            let bytes = scene(1).encode(format, &SaveOptions::default(), world).unwrap();
            assert!(fs::read(&path).unwrap() == bytes, "{name}");
            assert_eq!(decode_world(&bytes, Some(format)).unwrap(), found, "{name}");
            found
        };
        let keeps = format.keeps_world(&SaveOptions::default());
        assert_eq!(keeps, name != "a.splat");
        let away = DVec3::new(0.1, -2e30, 3.0);
        let landmarks = vec![("photo é 1.jpg".into(), DVec3::ZERO), ("a b.png".into(), away)];
        let photo = World {
            origin: Origin::Photo("images/photo é 1.jpg".into()),
            landmarks,
            lens: Some(scenes::camera(640, 480).intrinsics),
            up: Some(DVec3::NEG_Y),
            turns: 3,
        };
        assert_eq!(saved(Some(&photo)), Some(photo).filter(|_| keeps), "{name}");
        let Some(World { origin: Origin::Cameras(found), .. }) = saved(Some(&Origin::Cameras(pose).into())) else {
            assert!(!keeps, "{name}");
            continue;
        };
        assert!(found.matrix().abs_diff_eq(pose.matrix(), 1e-15), "{name}: {found:?}, not {pose:?}");
        assert_eq!(saved(None), None, "{name}");
        // A line break would end the comment.
        assert_eq!(saved(Some(&Origin::Photo("a\nelement vertex 9".into()).into())), None, "{name}");
        assert_eq!(Scene::open(&path).unwrap().len(), scene(1).len(), "{name}");
    }
}
