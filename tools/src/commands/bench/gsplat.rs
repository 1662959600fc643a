//! gsplat on the same scene, for a ratio: needs Python with PyTorch and gsplat, and a CUDA GPU.

use super::python;
use crate::options::Size;
use std::{ffi::OsStr, path::Path, process::Command};
use zipsplat::{
    Error, Result,
    types::{Scene, write_ply},
};

const SCRIPT: &str = include_str!("../../../bench/gsplat_render.py");
const NEEDED: &str = "a Python with PyTorch and gsplat, on a CUDA GPU";

/// Holds that `python` can do it.
///
/// # Errors
/// [`Error::Argument`] where it does not run or lacks something, with what it said.
pub fn check(python: &Path) -> Result<()> {
    run(python, &[]).map(drop)
}

/// Milliseconds that gsplat takes for one of `repeats` frames in a row.
///
/// # Errors
/// As [`check`].
pub fn milliseconds(python: &Path, scene: &Scene, size: Size, repeats: u32) -> Result<f64> {
    let folder = tempfile::tempdir().map_err(|error| Error::io("temporary folder", error))?;
    let file = folder.path().join("scene.ply");
    write_ply(scene, &file)?;
    let numbers = [size.0, size.1, repeats].map(|number| number.to_string());
    let printed = run(python, &[file.as_os_str(), numbers[0].as_ref(), numbers[1].as_ref(), numbers[2].as_ref()])?;
    printed.trim().parse().map_err(|_| Error::argument("--gsplat", printed.trim(), "milliseconds"))
}

fn run(python: &Path, arguments: &[&OsStr]) -> Result<String> {
    python::run("--gsplat", NEEDED, Command::new(python).arg("-c").arg(SCRIPT).args(arguments))
}
