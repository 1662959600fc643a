//! gsplat on the same scene, for a ratio: needs Python with PyTorch and gsplat, and a CUDA GPU.

use crate::options::Size;
use std::{
    env,
    ffi::OsStr,
    fmt::Display,
    fs,
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

/// Holds that `python` can do it.
///
/// # Errors
/// [`Error::Argument`] where it does not run or lacks something, with what it said.
pub fn check(python: &Path) -> Result<()> {
    run(python, &[]).map(drop)
}

/// Milliseconds that gsplat takes for a frame.
///
/// # Errors
/// As [`check`].
pub fn milliseconds(python: &Path, scene: &Scene, size: Size, repeats: u32) -> Result<f64> {
    let file = SceneFile(env::temp_dir().join(format!("zipsplat-bench-{}.ply", process::id())));
    write_ply(scene, &file.0)?;
    let numbers = [size.0, size.1, repeats].map(|number| number.to_string());
    let printed = run(python, &[file.0.as_os_str(), numbers[0].as_ref(), numbers[1].as_ref(), numbers[2].as_ref()])?;
    printed.trim().parse().map_err(|_| Error::argument("--gsplat", printed.trim(), "milliseconds"))
}

/// Runs the script and returns what it printed.
fn run(python: &Path, arguments: &[&OsStr]) -> Result<String> {
    let failed = |said: &dyn Display| Error::argument("--gsplat", format!("{}: {said}", python.display()), NEEDED);
    let output = Command::new(python).arg("-c").arg(SCRIPT).args(arguments).output().map_err(|error| failed(&error))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(failed(&said.trim().lines().last().unwrap_or("it failed")));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
