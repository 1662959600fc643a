//! The forward pass in PyTorch on this machine, to compare with: our own code in `tools/train`, run by an installed Python.

use serde::Deserialize;
use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
};
use zipsplat::{Error, Result, weights::Architecture};

/// What Python runs, under the names it imports.
const FILES: [(&str, &str); 3] = [
    ("pytorch_forward.py", include_str!("../../../bench/pytorch_forward.py")),
    ("model.py", include_str!("../../../train/model.py")),
    ("weights.py", include_str!("../../../train/weights.py")),
];

/// What PyTorch needed.
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
    /// Of every run; absent where it failed.
    pub ms: Option<Vec<f64>>,
    /// On GPUs.
    pub peak_bytes: Option<u64>,
    pub failed: Option<String>,
}

/// Times a network for each of `views` and, views outermost, each of `ratios`.
///
/// # Errors
/// [`Error::Argument`] where `python` cannot be run, or ends in an error, whose last line is told.
pub fn forward(
    python: &Path,
    architecture: &Architecture,
    views: &[usize],
    ratios: &[f64],
    size: &str,
    [warmup, repeats]: [u32; 2],
) -> Result<Pytorch> {
    let folder = tempfile::tempdir().map_err(|error| Error::io("temporary folder", error))?;
    for (name, text) in FILES {
        let path = folder.path().join(name);
        fs::write(&path, text).map_err(|error| Error::io(path, error))?;
    }
    let list = |numbers: Vec<String>| numbers.join(",");
    let architecture = serde_json::to_string(architecture).expect("numbers and names are JSON");
    let mut command = Command::new(python);
    command.arg(folder.path().join(FILES[0].0)).args(["--architecture", &architecture, "--size", size]);
    command.args(["--views", &list(views.iter().map(usize::to_string).collect())]);
    command.args(["--ratio", &list(ratios.iter().map(f64::to_string).collect())]);
    command.args(["--warmup", &warmup.to_string(), "--repeats", &repeats.to_string()]);
    let failed = |found: String| {
        Error::argument(
            "--pytorch",
            format!("{}: {found}", python.display()),
            "a Python with torch, numpy and safetensors",
        )
    };
    let output = command.stdin(Stdio::null()).output().map_err(|error| failed(error.to_string()))?;
    if !output.status.success() {
        let told = String::from_utf8_lossy(&output.stderr);
        return Err(failed(told.lines().last().unwrap_or("no message").to_owned()));
    }
    serde_json::from_slice(&output.stdout).map_err(|error| failed(format!("its output, {error}")))
}
