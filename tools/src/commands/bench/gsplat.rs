//! gsplat on the same scene, for a ratio: needs Python with PyTorch and gsplat, and a CUDA GPU.

use crate::options::Size;
use std::{
    env, fs,
    path::{Path, PathBuf},
    process::{self, Command},
};
use zipsplat::{
    Error, Result,
    types::{Scene, write_ply},
};

const SCRIPT: &str = include_str!("../../../bench/gsplat_render.py");
const NEEDED: &str = "a Python with PyTorch and gsplat, on a CUDA GPU";

/// A scene in a file, gone when this is dropped.
struct SceneFile(PathBuf);

impl Drop for SceneFile {
    fn drop(&mut self) {
        // What is left in the system's temporary folder is the system's to clear.
        let _ = fs::remove_file(&self.0);
    }
}

/// Milliseconds that gsplat takes for a frame.
///
/// # Errors
/// [`Error::Argument`] where `python` does not run or lacks something, with what it said.
pub fn milliseconds(python: &Path, scene: &Scene, size: Size, repeats: u32) -> Result<f64> {
    let file = SceneFile(env::temp_dir().join(format!("zipsplat-bench-{}.ply", process::id())));
    write_ply(scene, &file.0)?;
    let numbers = [size.0, size.1, repeats].map(|number| number.to_string());
    let output = Command::new(python).arg("-c").arg(SCRIPT).arg(&file.0).args(numbers).output();
    let output =
        output.map_err(|error| Error::argument("--gsplat", format!("{}: {error}", python.display()), NEEDED))?;
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    let found = out.trim().parse().ok().filter(|_| output.status.success());
    found.ok_or_else(|| {
        let said = err.trim().lines().last().unwrap_or("nothing").to_owned();
        Error::argument("--gsplat", format!("{}: {said}", python.display()), NEEDED)
    })
}
