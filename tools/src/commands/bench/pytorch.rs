//! Network, depth and refinement step in PyTorch, by `tools/train`.

use crate::options::Size;
use serde::Deserialize;
use std::{path::Path, process::Command};
use zipsplat::{
    Error, Result,
    types::{Scene, write_ply},
    weights::{Architecture, DepthArchitecture},
};

/// Python's files by import name.
const FILES: [(&str, &str); 4] = [
    ("pytorch_forward.py", include_str!("../../../bench/pytorch_forward.py")),
    ("model.py", include_str!("../../../train/model.py")),
    ("layers.py", include_str!("../../../train/layers.py")),
    ("weights.py", include_str!("../../../train/weights.py")),
];

const DEPTH_FILES: [(&str, &str); 5] = [
    ("pytorch_depth.py", include_str!("../../../bench/pytorch_depth.py")),
    ("depth.py", include_str!("../../../train/depth.py")),
    FILES[1],
    FILES[2],
    FILES[3],
];

const REFINE_FILES: [(&str, &str); 6] = [
    ("pytorch_refine.py", include_str!("../../../bench/pytorch_refine.py")),
    super::python::SCENE,
    ("rasterize.py", include_str!("../../../train/rasterize.py")),
    ("rasterize_numba.py", include_str!("../../../train/rasterize_numba.py")),
    ("rasterize_triton.py", include_str!("../../../train/rasterize_triton.py")),
    ("splats.py", include_str!("../../../train/splats.py")),
];

const REFINE_NEEDED: &str = "a Python with torch, numpy and, without a CUDA GPU, numba";
const NEEDED: &str = "a Python with torch, numpy and safetensors";

#[derive(Deserialize)]
pub struct Pytorch {
    pub device: String,
    pub torch: String,
    pub rows: Vec<Row>,
}

#[derive(Deserialize)]
pub struct Row {
    pub precision: String,
    pub views: usize,
    pub ratio: f64,
    /// Absent after a failure.
    pub ms: Option<Vec<f64>>,
    pub peak_bytes: Option<u64>,
    pub failed: Option<String>,
}

pub fn check(python: &Path) -> Result<()> {
    let mut command = Command::new(python);
    super::python::run("--pytorch", NEEDED, command.args(["-c", "import torch, numpy, safetensors"])).map(drop)
}

/// One case per number of views and share of the tokens.
pub fn forward(
    python: &Path,
    architecture: &Architecture,
    cases: &[(usize, f64)],
    size: &str,
    [warmup, repeats]: [u32; 2],
) -> Result<Pytorch> {
    let folder = super::python::folder(&FILES)?;
    let list = |numbers: Vec<String>| numbers.join(",");
    let architecture = serde_json::to_string(architecture).expect("numbers and names are JSON");
    let mut command = Command::new(python);
    command.arg(folder.path().join(FILES[0].0)).args(["--architecture", &architecture, "--size", size]);
    command.args(["--views", &list(cases.iter().map(|(views, _)| views.to_string()).collect())]);
    command.args(["--ratio", &list(cases.iter().map(|(_, ratio)| ratio.to_string()).collect())]);
    command.args(["--warmup", &warmup.to_string(), "--repeats", &repeats.to_string()]);
    let printed = super::python::run("--pytorch", NEEDED, &mut command)?;
    serde_json::from_str(&printed)
        .map_err(|error| Error::argument("--pytorch", format!("{}: {error}", python.display()), NEEDED))
}

#[derive(Deserialize)]
pub struct Depth {
    pub device: String,
    pub torch: String,
    pub rows: Vec<DepthRow>,
}

#[derive(Deserialize)]
pub struct DepthRow {
    pub backbone_ms: Vec<f64>,
    pub heads_ms: Vec<f64>,
}

/// One case per number of views and size.
pub fn depth(
    python: &Path,
    architecture: &DepthArchitecture,
    cases: &[(usize, Size)],
    [warmup, repeats]: [u32; 2],
) -> Result<Depth> {
    let folder = super::python::folder(&DEPTH_FILES)?;
    let architecture = serde_json::to_string(architecture).expect("numbers and names are JSON");
    let mut command = Command::new(python);
    command.arg(folder.path().join(DEPTH_FILES[0].0)).arg(architecture).args([warmup, repeats].map(|n| n.to_string()));
    command.args(cases.iter().map(|(views, size)| format!("{views}x{size}")));
    let printed = super::python::run("--pytorch", NEEDED, &mut command)?;
    serde_json::from_str(&printed)
        .map_err(|error| Error::argument("--pytorch", format!("{}: {error}", python.display()), NEEDED))
}

#[derive(Deserialize)]
pub struct Steps {
    pub device: String,
    pub torch: String,
    pub picture_ms: Vec<f64>,
    pub step_ms: Vec<f64>,
}

pub fn check_refine(python: &Path) -> Result<()> {
    let mut command = Command::new(python);
    super::python::run("--pytorch", REFINE_NEEDED, command.args(["-c", REFINE_FILES[0].1])).map(drop)
}

pub fn refine(
    python: &Path,
    scene: &Scene,
    Size(width, height): Size,
    photos: usize,
    [warmup, repeats]: [u32; 2],
) -> Result<Steps> {
    let folder = super::python::folder(&REFINE_FILES)?;
    let file = folder.path().join("scene.ply");
    write_ply(scene, &file)?;
    let mut command = Command::new(python);
    command.arg(folder.path().join(REFINE_FILES[0].0)).arg(&file);
    command.args([width, height, photos as u32, warmup, repeats].map(|number| number.to_string()));
    let printed = super::python::run("--pytorch", REFINE_NEEDED, &mut command)?;
    serde_json::from_str(&printed)
        .map_err(|error| Error::argument("--pytorch", format!("{}: {error}", python.display()), REFINE_NEEDED))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Also indirect imports of tools/train and tools/bench.
    #[test]
    fn scripts_find_what_they_import() {
        let tools = Path::new(env!("CARGO_MANIFEST_DIR"));
        for files in [&FILES[..], &DEPTH_FILES, &REFINE_FILES] {
            for (name, text) in files {
                let words = text.lines().filter_map(|line| {
                    let line = line.trim_start();
                    line.strip_prefix("from ").or_else(|| line.strip_prefix("import "))?.split([' ', ',', '.']).next()
                });
                let own = words
                    .map(|word| format!("{word}.py"))
                    .filter(|file| ["train", "bench"].iter().any(|folder| tools.join(folder).join(file).exists()));
                for file in own {
                    assert!(files.iter().any(|(other, _)| *other == file), "{name} imports {file}");
                }
            }
        }
    }
}
