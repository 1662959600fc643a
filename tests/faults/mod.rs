//! Device loss and failing drivers, simulated by `failing.c`.

use crate::processes::{assert_succeeds, child};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const LAYER: &str = "VK_LAYER_ZIPSPLAT_faults";

const FAULTS: &str = "ZIPSPLAT_FAULTS";

pub const OUT_OF_HOST_MEMORY: i32 = -1;
pub const OUT_OF_DEVICE_MEMORY: i32 = -2;
pub const DEVICE_LOST: i32 = -4;

/// Runs an ignored test in a process under the layer, under silent validation.
#[track_caller]
pub fn assert_survives(name: &str) {
    let (own, work) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let at = |name: &str| own.path().join(name);
    build_layer(&own);
    // Messages during device destruction cannot fail a test.
    let settings = std::fs::read_to_string(tests().join("vk_layer_settings.txt")).unwrap();
    let printing =
        "khronos_validation.debug_action = VK_DBG_LAYER_ACTION_LOG_MSG\nkhronos_validation.log_filename = stdout\n";
    std::fs::write(at("settings.txt"), settings + printing).unwrap();
    let mut command = child(name, work.path(), "set -- timeout --kill-after=5 600 \"$@\"");
    let layers = match std::env::var("VK_LAYER_PATH") {
        Ok(path) => ("VK_LAYER_PATH", format!("{path}:{}", own.path().display())),
        Err(_) => ("VK_ADD_LAYER_PATH", own.path().display().to_string()),
    };
    command.env(layers.0, layers.1).env("VK_INSTANCE_LAYERS", LAYER).env("VK_LAYER_SETTINGS_PATH", at("settings.txt"));
    command.env(FAULTS, at("faults")).env("ZIPSPLAT_CACHE", at("cache"));
    let printed = assert_succeeds(command);
    assert!(!printed.contains("VUID"), "{printed}");
}

fn tests() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn build_layer(folder: &TempDir) {
    let library = folder.path().join("libfaults.so");
    let source = tests().join("faults/failing.c");
    let mut compiler = std::process::Command::new("cc");
    compiler
        .args(["-std=gnu99", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC", "-o"])
        .arg(&library)
        .arg(source);
    assert!(compiler.status().expect("a C compiler").success());
    let layer = serde_json::json!({
        "name": LAYER, "type": "GLOBAL", "library_path": library, "api_version": "1.3.0",
        "implementation_version": "1", "description": "Failing calls",
    });
    let manifest = serde_json::json!({ "file_format_version": "1.2.0", "layer": layer });
    std::fs::write(folder.path().join("faults.json"), manifest.to_string()).unwrap();
}

pub struct Faults(PathBuf);

impl Faults {
    /// # Panics
    /// Outside a process of [`assert_survives`].
    pub fn inherited() -> Self {
        Self(std::env::var_os(FAULTS).expect("a child of this module's tests").into())
    }

    pub fn set(&self, function: &str, first: u32, result: i32) {
        std::fs::write(&self.0, format!("{function} {first} {result}")).unwrap();
    }

    /// Number of calls on the last destroyed device.
    pub fn made(&self) -> u32 {
        let text = std::fs::read_to_string(&self.0).unwrap();
        text.split(' ').nth(1).and_then(|calls| calls.parse().ok()).expect("what the layer wrote")
    }

    /// Returns up to `count` of these calls, with the first and the last.
    pub fn calls(&self, count: u32) -> Vec<u32> {
        let last = self.made();
        assert!(last > 0, "never called");
        let mut calls: Vec<u32> = (0..count).map(|i| 1 + i * (last - 1) / (count - 1)).collect();
        calls.dedup();
        calls
    }
}
