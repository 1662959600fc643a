//! Damaged files: parsers return a valid result, or an error with the file's name. They never
//! panic, hang or allocate by an untrusted count.

mod mutate;
mod seeds;
mod special;

use crate::below;
use mutate::mutated;
use seeds::LENS;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};
use std::{collections::BTreeSet, io::Read};
use zipsplat::{types::poses::read_cloud, types::read_points};
use zipsplat_tests::architectures::pico;
use zipsplat_tests::prelude::*;

struct Parser {
    name: &'static str,
    seeds: Vec<Vec<u8>>,
    /// Repairs checksum or archive.
    wrap: fn(&[u8]) -> Vec<u8>,
    read: fn(&Path, &[u8]) -> Result<(), Error>,
}

fn plain(bytes: &[u8]) -> Vec<u8> {
    bytes.to_vec()
}

fn stored(folder: &Path, name: &str, bytes: &[u8]) -> std::path::PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

fn sound_scene(scene: &Scene) {
    scene.validate().expect("what is read is valid");
}

fn sound_cameras(poses: &Capture) {
    for frame in &poses.frames {
        frame.camera.validate(&frame.name).expect("what is read is valid");
    }
}

fn scene(folder: &Path, name: &str, bytes: &[u8]) -> Result<(), Error> {
    let path = stored(folder, name, bytes);
    if let Ok(mut scene) = Scene::open_unchecked(&path) {
        scene.drop_invalid().expect("arrays that fit each other");
        sound_scene(&scene);
    }
    Scene::open(path).map(|scene| sound_scene(&scene))
}

fn cameras(folder: &Path, bytes: &[u8]) -> Result<(), Error> {
    Capture::open_cameras(stored(folder, "cameras.json", bytes), &LENS).map(|poses| sound_cameras(&poses))
}

fn colmap(folder: &Path, files: [(&str, &[u8]); 2]) -> Result<(), Error> {
    let model = tempfile::tempdir_in(folder).unwrap();
    for (name, bytes) in files {
        stored(model.path(), name, bytes);
    }
    Capture::open(model.path()).map(|poses| sound_cameras(&poses))
}

fn checkpoint(folder: &Path, bytes: &[u8]) -> Result<(), Error> {
    let path = stored(folder, "weights", bytes);
    let mut values = Vec::new();
    for opened in [Checkpoint::open_architecture(&path, pico()), Checkpoint::open(&path, None)] {
        let weights = opened?;
        for (name, shape) in weights.parameters() {
            values.resize(shape.iter().product(), 0.0);
            weights.read_f32(name, &mut values)?;
        }
    }
    Ok(())
}

fn parsers() -> Vec<Parser> {
    let parser = |name, seeds, read| Parser { name, seeds, wrap: plain, read };
    let spz = seeds::scene("spz", 1);
    vec![
        parser("PLY", vec![seeds::scene("ply", 0), seeds::scene("ply", 3), seeds::ascii_ply()], |folder, bytes| {
            let points = read_points(stored(folder, "points.ply", bytes));
            let read = scene(folder, "scene.ply", bytes);
            points.and(read)
        }),
        parser("SPZ", vec![spz.clone()], |folder, bytes| scene(folder, "scene.spz", bytes)),
        Parser {
            wrap: seeds::deflated,
            ..parser("SPZ inside", vec![gunzip(&spz)], |folder, bytes| scene(folder, "scene.spz", bytes))
        },
        parser("SPZ 4", vec![seeds::spz4(0), seeds::spz4(1)], |folder, bytes| scene(folder, "scene.spz", bytes)),
        parser("packed PLY", vec![seeds::packed_ply()], |folder, bytes| scene(folder, "scene.ply", bytes)),
        parser("SOG", vec![seeds::scene("sog", 1)], |folder, bytes| scene(folder, "scene.sog", bytes)),
        parser(".splat", vec![seeds::scene("splat", 0)], |folder, bytes| scene(folder, "scene.splat", bytes)),
        parser("glb", vec![seeds::scene("glb", 1)], |folder, bytes| scene(folder, "scene.glb", bytes)),
        parser("glTF", vec![seeds::scene("gltf", 0)], |folder, bytes| scene(folder, "scene.gltf", bytes)),
        parser("transforms.json", vec![seeds::transforms()], |folder, bytes| {
            Capture::open(stored(folder, "transforms.json", bytes)).map(|poses| sound_cameras(&poses))
        }),
        parser("camera path", vec![seeds::camera_path(), seeds::matrices()], cameras),
        parser("COLMAP text images", vec![seeds::COLMAP_IMAGES.into()], |folder, bytes| {
            colmap(folder, [("cameras.txt", seeds::COLMAP_CAMERAS.as_bytes()), ("images.txt", bytes)])
        }),
        parser("COLMAP text cameras", vec![seeds::COLMAP_CAMERAS.into()], |folder, bytes| {
            colmap(folder, [("cameras.txt", bytes), ("images.txt", seeds::COLMAP_IMAGES.as_bytes())])
        }),
        parser("COLMAP binary images", vec![seeds::colmap_images()], |folder, bytes| {
            colmap(folder, [("cameras.bin", &seeds::colmap_cameras()), ("images.bin", bytes)])
        }),
        parser("COLMAP binary cameras", vec![seeds::colmap_cameras()], |folder, bytes| {
            colmap(folder, [("cameras.bin", bytes), ("images.bin", &seeds::colmap_images())])
        }),
        parser("COLMAP text points", vec![seeds::COLMAP_POINTS.into()], |folder, bytes| {
            read_cloud(stored(folder, "points3D.txt", bytes)).map(drop)
        }),
        parser("COLMAP binary points", vec![seeds::colmap_points()], |folder, bytes| {
            read_cloud(stored(folder, "points3D.bin", bytes)).map(drop)
        }),
        parser("safetensors", vec![seeds::safetensors()], checkpoint),
        parser("checkpoint archive", vec![seeds::archive(&seeds::pickle())], checkpoint),
        Parser { wrap: seeds::archive, ..parser("pickle", vec![seeds::pickle()], checkpoint) },
        parser(
            "photos",
            vec![
                seeds::photo(image::ImageFormat::Png),
                seeds::photo(image::ImageFormat::Jpeg),
                seeds::photo(image::ImageFormat::WebP),
            ],
            |folder, bytes| {
                let path = stored(folder, "photo", bytes);
                let size = Image::size(&path);
                let image = Image::open(&path)?;
                assert_eq!(size.expect("what opens has a size"), (image.width, image.height));
                Ok(())
            },
        ),
    ]
}

const PATIENCE: Duration = Duration::from_secs(20);

/// Accepted or rejected; an error describes a parser's bug.
fn judged(parser: &Parser, folder: &Path, bytes: &[u8]) -> Result<bool, String> {
    let start = Instant::now();
    let result = catch_unwind(AssertUnwindSafe(|| (parser.read)(folder, bytes)));
    if start.elapsed() > PATIENCE {
        return Err(format!("took {:?}", start.elapsed()));
    }
    match result {
        Ok(Ok(())) => Ok(true),
        Ok(Err(Error::Format { .. } | Error::Io { .. } | Error::Weights { .. } | Error::Argument { .. })) => Ok(false),
        Ok(Err(error)) => Err(format!("an error of another kind: {error}")),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("?");
            Err(format!("panicked: {text}"))
        }
    }
}

fn fuzz(rounds: u64, seed: u64) {
    let mut problems = Vec::new();
    for parser in parsers() {
        let folder = tempfile::tempdir().unwrap();
        let (mut refused, mut read) = (0, 0);
        for round in 0..rounds {
            let mut random = Random::new(seed.wrapping_add(round) << 8);
            let original = &parser.seeds[below(&mut random, parser.seeds.len())];
            let other = &parser.seeds[below(&mut random, parser.seeds.len())];
            let bytes = (parser.wrap)(&mutated(original, other, &mut random));
            let place = format!("{}, seed {seed}, round {round}, {} bytes", parser.name, bytes.len());
            match judged(&parser, folder.path(), &bytes) {
                Ok(true) => read += 1,
                Ok(false) => refused += 1,
                Err(problem) => problems.push(format!("{place}: {problem}")),
            }
        }
        assert!(refused > 0, "{}: nothing was refused, so nothing was damaged ({read} read)", parser.name);
    }
    assert!(problems.is_empty(), "{} problems:\n{}", problems.len(), problems.join("\n"));
}

#[test]
fn sound_files_are_read() {
    for parser in parsers() {
        let folder = tempfile::tempdir().unwrap();
        for seed in &parser.seeds {
            // Points are not a scene, and a pickle does not name its network.
            let read = (parser.read)(folder.path(), &(parser.wrap)(seed));
            let unnamed = matches!(&read, Err(Error::Argument { .. } | Error::Format { .. }) if parser.name.contains("archive") || parser.name == "pickle");
            assert!(read.is_ok() || unnamed, "{}: {:?}", parser.name, read.err().map(|error| error.to_string()));
        }
    }
}

#[test]
fn damaged_files_are_refused_or_read_soundly() {
    fuzz(300, 1);
}

/// `ZIPSPLAT_FUZZ_SEED=2 tools/test.sh -p zipsplat-tests --test numerics -- --ignored
/// many_damaged_files`. Under `ulimit -v 4000000` oversized allocations fail.
#[test]
#[ignore = "minutes"]
fn many_damaged_files() {
    let number = |name: &str, default| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    fuzz(number("ZIPSPLAT_FUZZ_ROUNDS", 20_000), number("ZIPSPLAT_FUZZ_SEED", 1) << 32);
}

/// From cargo-fuzz (`tests/fuzz`), named by parser.
#[test]
fn what_a_fuzzer_found_is_refused_or_read_soundly() {
    let file = std::fs::File::open(golden::find("hostile.zip").expect("it is committed")).unwrap();
    let mut archive = zip::ZipArchive::new(file).unwrap();
    let parsers = parsers();
    let folder = tempfile::tempdir().unwrap();
    let (mut problems, mut seen) = (Vec::new(), BTreeSet::new());
    for i in 0..archive.len() {
        let mut entry = archive.by_index(i).unwrap();
        let (name, mut bytes) = (entry.name().to_owned(), Vec::new());
        entry.read_to_end(&mut bytes).unwrap();
        let parser = name.split_once('/').and_then(|(kind, _)| parsers.iter().find(|parser| parser.name == kind));
        let parser = parser.unwrap_or_else(|| panic!("{name}: no parser has this name"));
        seen.insert(parser.name);
        problems.extend(
            judged(parser, folder.path(), &(parser.wrap)(&bytes)).err().map(|problem| format!("{name}: {problem}")),
        );
    }
    assert!(seen.len() >= 14, "only {seen:?}");
    assert!(problems.is_empty(), "{} problems:\n{}", problems.len(), problems.join("\n"));
}
