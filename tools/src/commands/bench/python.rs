//! Benchmark scripts for an installed Python.

use std::{
    fs,
    process::{Command, Stdio},
};
use zipsplat::{Error, Result};

pub const SCENE: (&str, &str) = ("scene.py", include_str!("../../../bench/scene.py"));

/// `option` names the Python option, `needed` its requirement.
pub fn run(option: &str, needed: &str, command: &mut Command) -> Result<String> {
    let python = command.get_program().display().to_string();
    let failed = |message: &str| Error::argument(option, format!("{python}: {message}"), needed);
    let output = command.stdin(Stdio::null()).output().map_err(|error| failed(&error.to_string()))?;
    if !output.status.success() {
        let message = String::from_utf8_lossy(&output.stderr);
        return Err(failed(message.trim().lines().last().unwrap_or("it failed")));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

pub fn folder(files: &[(&str, &str)]) -> Result<tempfile::TempDir> {
    let folder = tempfile::tempdir().map_err(|error| Error::io("temporary folder", error))?;
    for (name, text) in files {
        let path = folder.path().join(name);
        fs::write(&path, text).map_err(|error| Error::io(path, error))?;
    }
    Ok(folder)
}
