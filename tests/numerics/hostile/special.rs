//! Pipes and devices, which would block or never end.

use super::{seeds, seeds::LENS};
use std::{process::Command, sync::mpsc, thread, time::Duration};
use zipsplat::types::{read_points, read_world};
use zipsplat::{Result, types::poses::read_cloud, weights::convert};
use zipsplat_tests::prelude::*;

const PATIENCE: Duration = Duration::from_secs(20);

type Reader = fn(&Path) -> Result<()>;

const READERS: [(&str, &str, Reader); 15] = [
    ("weights", "weights.pt", |path| Checkpoint::open(path, None).map(drop)),
    ("conversion", "weights.safetensors", |path| convert(path, path.with_extension("out"), Dtype::F16, None)),
    ("PLY", "scene.ply", |path| Scene::open(path).map(drop)),
    ("SPZ", "scene.spz", |path| Scene::open(path).map(drop)),
    ("SOG", "scene.sog", |path| Scene::open(path).map(drop)),
    (".splat", "scene.splat", |path| Scene::open(path).map(drop)),
    ("glTF", "scene.gltf", |path| Scene::open(path).map(drop)),
    ("glb", "scene.glb", |path| Scene::open(path).map(drop)),
    ("origin", "scene.ply", |path| read_world(path).map(drop)),
    ("points", "points.ply", |path| read_points(path).map(drop)),
    ("COLMAP points", "points3D.bin", |path| read_cloud(path).map(drop)),
    ("poses", "transforms.json", |path| Capture::open(path).map(drop)),
    ("cameras", "cameras.json", |path| Capture::open_cameras(path, &LENS).map(drop)),
    ("photo", "photo.png", |path| Image::open(path).map(drop)),
    ("size of a photo", "photo.png", |path| Image::size(path).map(drop)),
];

/// On a thread that is abandoned if it hangs.
#[track_caller]
fn refusal(name: &str, read: Reader, path: PathBuf) -> Error {
    let (send, receive) = mpsc::channel();
    let at = path.clone();
    thread::spawn(move || send.send(read(&at)));
    match receive.recv_timeout(PATIENCE) {
        Ok(Err(error)) => error,
        other => panic!("{name}: {}: {other:?}", path.display()),
    }
}

fn pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().expect("mkfifo").success());
}

#[test]
fn pipes_and_devices_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (i, (name, file, read)) in READERS.into_iter().enumerate() {
        let place = |kind: &str| {
            let place = folder.path().join(format!("{kind}{i}"));
            std::fs::create_dir(&place).unwrap();
            place.join(file)
        };
        pipe(&place("pipe"));
        std::os::unix::fs::symlink("/dev/zero", place("device")).unwrap();
        for kind in ["pipe", "device"] {
            let path = folder.path().join(format!("{kind}{i}")).join(file);
            let error = refusal(name, read, path);
            assert!(matches!(error, Error::Argument { .. }), "{name}: {error}");
            let said = error.to_string();
            assert!(
                said.contains(&format!("found a {kind}, expected a regular file"))
                    || name == "poses"
                    || name == "cameras",
                "{said}"
            );
        }
    }
}

#[test]
fn pipes_that_a_file_names_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("cameras.bin"), seeds::colmap_cameras()).unwrap();
    pipe(&at("images.bin"));
    let poses: Reader = |path| Capture::open(path).map(drop);
    let error = refusal("COLMAP", poses, folder.path().into()).to_string();
    assert!(error.contains("images.bin: found a pipe"), "{error}");

    std::fs::write(at("scene.gltf"), r#"{"asset":{"version":"2.0"},"buffers":[{"uri":"a.bin","byteLength":4}]}"#)
        .unwrap();
    pipe(&at("a.bin"));
    let error = refusal("glTF", |path| Scene::open(path).map(drop), at("scene.gltf")).to_string();
    assert!(error.contains("a.bin: found a pipe"), "{error}");
}
