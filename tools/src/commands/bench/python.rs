//! Scripts that an installed Python runs, to compare with.

use std::process::{Command, Stdio};
use zipsplat::{Error, Result};

/// Runs `command` and returns what it printed. `option` named the Python, and `needed` is what it has to be.
///
/// # Errors
/// [`Error::Argument`] where it cannot be run or ends in an error, with the last line that it said.
pub fn run(option: &str, needed: &str, command: &mut Command) -> Result<String> {
    let python = command.get_program().display().to_string();
    let failed = |said: &str| Error::argument(option, format!("{python}: {said}"), needed);
    let output = command.stdin(Stdio::null()).output().map_err(|error| failed(&error.to_string()))?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        return Err(failed(said.trim().lines().last().unwrap_or("it failed")));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}
