//! gsplat on the same scene, with Python, PyTorch and a CUDA GPU.

use super::python;
use crate::options::Size;
use std::{path::Path, process::Command};
use zipsplat::{
    Error, Result,
    types::{Scene, write_ply},
};

/// Python's files by import name.
const FILES: [(&str, &str); 2] = [("gsplat_render.py", include_str!("../../../bench/gsplat_render.py")), python::SCENE];
const NEEDED: &str = "a Python with PyTorch and gsplat, on a CUDA GPU";

pub fn check(python: &Path) -> Result<()> {
    run(Command::new(python).arg("-c").arg(FILES[0].1)).map(drop)
}

/// Returns milliseconds per frame over consecutive frames.
pub fn milliseconds(python: &Path, scene: &Scene, size: Size, repeats: u32) -> Result<f64> {
    let folder = python::folder(&FILES)?;
    let file = folder.path().join("scene.ply");
    write_ply(scene, &file)?;
    let mut command = Command::new(python);
    command.arg(folder.path().join(FILES[0].0)).arg(&file);
    let printed = run(command.args([size.0, size.1, repeats].map(|number| number.to_string())))?;
    printed.trim().parse().map_err(|_| Error::argument("--gsplat", printed.trim(), "milliseconds"))
}

fn run(command: &mut Command) -> Result<String> {
    python::run("--gsplat", NEEDED, command)
}
