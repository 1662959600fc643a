//! The command line, in process.

mod batch;
mod blocks;
mod cameras;
mod cancel;
mod colmap_ends;
mod compare;
mod convert;
mod depth;
mod edit;
mod errors;
mod eval;
mod external_scene;
mod heic;
mod host;
mod info;
mod known_depth;
mod mapping;
mod masks;
mod measure;
mod outputs;
mod placed;
mod protocol;
mod reconstruct;
mod refine;
mod render;
mod select;
mod server;
mod trajectories;
mod vggt;
mod video;
mod view;
mod weights;
mod wide;

use std::{
    ops::ControlFlow::Continue,
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
};
use tempfile::TempDir;
use zipsplat::{
    types::{Image, poses::Capture, write_ply},
    weights::{Checkpoint, DepthArchitecture, DepthCheckpoint, Dtype},
};
use zipsplat_tests::{architectures, command::run as raw_command, scenes};

#[derive(Debug)]
struct Outcome {
    code: u8,
    out: String,
    err: String,
}

impl Outcome {
    #[track_caller]
    fn success(self) -> String {
        assert_eq!(self.code, 0, "{}", self.err);
        self.out
    }

    #[track_caller]
    fn json(self) -> serde_json::Value {
        let envelope: serde_json::Value =
            serde_json::from_str(&self.success()).expect("--json prints JSON and nothing else");
        assert_eq!(envelope["schema_version"], 1);
        envelope["result"].clone()
    }

    #[track_caller]
    fn fails_usage(self) {
        assert_eq!((self.code, self.out.as_str()), (2, ""), "{}", self.err);
    }

    /// One line contains all `words`.
    #[track_caller]
    fn fails(self, code: u8, words: &[&str]) {
        assert_eq!((self.code, self.out.as_str()), (code, ""), "{}", self.err);
        let errors: Vec<_> = self.err.lines().filter(|line| !line.starts_with("note: ")).collect();
        assert!(matches!(errors[..], [line] if line.starts_with("error: ")), "not one error: {}", self.err);
        for word in words {
            assert!(errors[0].contains(word), "'{word}' is not in: {}", errors[0]);
        }
    }
}

fn zipsplat(line: &str) -> Outcome {
    command(line, &AtomicBool::new(false))
}

fn command(line: &str, cancelled: &AtomicBool) -> Outcome {
    let (code, out, err) = raw_command(line, cancelled);
    Outcome { code, out: String::from_utf8(out).expect("results are text"), err }
}

/// `photos/1.png`, `photos/10.png` and a small network's weights.
struct Folder(TempDir);

impl Folder {
    fn new() -> Self {
        let folder = Self(TempDir::new().expect("a temporary folder"));
        std::fs::create_dir(folder.path("photos")).expect("an empty folder");
        for (name, shift) in [("photos/10.png", 3), ("photos/1.png", 0)] {
            photo(40, 30, shift).save_png(folder.path(name)).expect("a photo can be written");
        }
        let checkpoint = Checkpoint::seeded_architecture(architectures::golden("micro"), "micro").expect("a network");
        checkpoint.save(folder.path("micro.safetensors"), Dtype::F32).expect("weights can be written");
        folder
    }

    /// Adds Depth Anything 3 weights for about 90 degrees: multi-view `da3.safetensors` and
    /// single-view `alone.safetensors`.
    fn with_depth(self) -> Self {
        for (name, architecture) in [
            ("da3.safetensors", architectures::depth_micro()),
            ("alone.safetensors", architectures::depth_micro_alone()),
        ] {
            let checkpoint = DepthCheckpoint::seeded(architecture, "micro").expect("a network");
            checkpoint.save_with(self.path(name), Dtype::F32, |_| Continue(())).expect("weights can be written");
            scale(&self.path(name), "model.cam_dec.fc_fov.0.weight", 1.0 / 64.0);
        }
        self
    }

    /// `vggt.safetensors` of VGGT, `tokens.safetensors` of ZipSplat on VGGT.
    fn with_vggt(self) -> Self {
        let architecture = DepthArchitecture::vggt("vggt-micro", 64, [1, 4], [0, 1, 2, 3], 8, [8; 4]);
        let architecture = DepthArchitecture { points: true, ..architecture };
        let checkpoint = DepthCheckpoint::seeded(architecture, "micro").expect("a network");
        let path = self.path("vggt.safetensors");
        checkpoint.save_with(&path, Dtype::F32, |_| Continue(())).expect("weights can be written");
        scale(&path, "camera_head.pose_branch.fc2.weight", 1.0 / 64.0);
        let tokens = Checkpoint::seeded_architecture(architectures::vggt_micro(), "micro").expect("a network");
        tokens.save(self.path("tokens.safetensors"), Dtype::F32).expect("weights can be written");
        self
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    #[track_caller]
    fn read(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).expect(name)
    }

    #[track_caller]
    fn text(&self, name: &str) -> String {
        std::fs::read_to_string(self.path(name)).expect(name)
    }

    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(&path, bytes).expect(name);
        path
    }

    #[cfg(unix)]
    fn script(&self, name: &str, text: &str) {
        use std::os::unix::fs::PermissionsExt;
        let path = self.write(name, text);
        std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).expect(name);
    }

    fn make(&self, name: &str) {
        std::fs::create_dir_all(self.path(name)).expect(name);
    }

    #[track_caller]
    fn remove(&self, name: &str) {
        std::fs::remove_file(self.path(name)).expect(name);
    }

    #[track_caller]
    fn edit_frames(&self, name: &str, mut edit: impl FnMut(&mut serde_json::Value)) {
        let mut cameras: serde_json::Value = serde_json::from_str(&self.text(name)).expect("JSON");
        cameras["frames"].as_array_mut().expect("frames").iter_mut().for_each(&mut edit);
        self.write(name, cameras.to_string());
    }

    #[track_caller]
    fn capture(&self, name: &str) -> Capture {
        Capture::open(self.path(name)).expect(name)
    }

    fn scatter(&self, name: &str, count: usize, sh_degree: u32, scale: f32) {
        write_ply(&scenes::random_scene(count, sh_degree, scale), self.path(name)).expect(name);
    }

    fn line(&self, line: &str) -> String {
        line.replace('@', &self.0.path().display().to_string())
    }

    fn run(&self, line: &str) -> Outcome {
        zipsplat(&self.line(line))
    }

    fn names(&self) -> Vec<String> {
        names(self.0.path())
    }
}

fn scale(file: &Path, name: &str, factor: f32) {
    let mut bytes = std::fs::read(file).expect("a file");
    let (length, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("safetensors");
    let Some(tensor) = header.info(name) else { return };
    let (from, to) = tensor.data_offsets;
    for value in bytes[8 + length + from..8 + length + to].as_chunks_mut().0 {
        *value = (factor * f32::from_le_bytes(*value)).to_le_bytes();
    }
    std::fs::write(file, bytes).expect("written");
}

fn names(folder: &Path) -> Vec<String> {
    let entries = folder.read_dir().expect("a folder");
    let mut names: Vec<_> =
        entries.map(|entry| entry.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

fn photo(width: u32, height: u32, shift: u32) -> Image {
    let pixel = |x: u32, y: u32| [5 * x + shift, 7 * y, 3 * (x + y)].map(|value| value as u8);
    let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect();
    Image { width, height, rgb, mask: None }
}
