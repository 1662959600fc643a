//! Fuzz targets. A panic, a hang, an allocation of a claimed size or an invalid result fails.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use tempfile::TempDir;
use zip::{ZipWriter, write::SimpleFileOptions};
use zipsplat::{
    types::{
        Image, Intrinsics,
        poses::{Capture, read_cloud, }, Scene,
    },
    weights::Checkpoint,
};

fn stored(name: &str, bytes: &[u8]) -> PathBuf {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let memory = Path::new("/dev/shm");
        if memory.is_dir() { TempDir::new_in(memory) } else { TempDir::new() }.expect("a temporary folder")
    });
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).expect("space for a file");
    path
}

pub fn scene(extension: &str, bytes: &[u8]) {
    let path = stored(&format!("scene.{extension}"), bytes);
    if let Ok(scene) = Scene::open(&path) {
        scene.validate().expect("what is read is valid");
    }
    if let Ok(mut scene) = Scene::open_unchecked(&path) {
        scene.drop_invalid().and_then(|_| scene.validate()).expect("what is left is valid");
    }
}

pub fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut out = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    out.write_all(bytes).and_then(|()| out.finish()).expect("memory")
}

fn sound(poses: zipsplat::Result<Capture>) {
    for frame in poses.map(|poses| poses.frames).unwrap_or_default() {
        frame.camera.validate(&frame.name).expect("what is read is valid");
    }
}

pub fn transforms(bytes: &[u8]) {
    sound(Capture::open(stored("transforms.json", bytes)));
}

pub fn camera_path(bytes: &[u8]) {
    let lens = Intrinsics { width: 64, height: 48, fx: 70.0, fy: 71.5, cx: 31.25, cy: 24.5 };
    sound(Capture::open_cameras(stored("cameras.json", bytes), &lens));
}

pub fn realestate(bytes: &[u8]) {
    stored("0.png", include_bytes!("../data/pre_up_120x97.png"));
    sound(Capture::open(stored("video.txt", &[b"http\n".as_slice(), bytes].concat())));
}

/// A COLMAP model of `extension`. The first two bytes are the images file's length.
pub fn colmap(extension: &str, bytes: &[u8]) {
    let Some(([low, high], rest)) = bytes.split_first_chunk::<2>().map(|(length, rest)| (*length, rest)) else {
        return;
    };
    let (cameras, images) = rest.split_at(usize::from(u16::from_le_bytes([low, high])).min(rest.len()));
    stored(&format!("images.{extension}"), images);
    let path = stored(&format!("cameras.{extension}"), cameras);
    sound(Capture::open(path));
}

pub fn points(name: &str, bytes: &[u8]) {
    for point in read_cloud(stored(name, bytes)).unwrap_or_default().positions {
        assert!(point.iter().all(|x| x.is_finite()), "what is read is finite");
    }
}

pub fn checkpoint(bytes: &[u8]) {
    for variant in [None, Some("vits")] {
        let Ok(weights) = Checkpoint::from_bytes("fuzzed", bytes.to_vec(), variant) else { continue };
        let mut values = Vec::new();
        for (name, shape) in weights.parameters() {
            values.resize(shape.iter().product(), 0.0);
            let _ = weights.read_f32(name, &mut values);
        }
    }
}

pub fn archive(pickle: &[u8]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in [("data.pkl", pickle), ("data/0", &[0; 4096])] {
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        zip.start_file(format!("fuzzed/{name}"), options).and_then(|()| Ok(zip.write_all(bytes)?)).expect("memory");
    }
    zip.finish().expect("memory").into_inner()
}

pub fn photo(bytes: &[u8]) {
    let path = stored("photo", bytes);
    let size = Image::size(&path);
    if let Ok(image) = Image::open(&path) {
        assert_eq!(size.expect("what opens has a size"), (image.width, image.height));
    }
}
