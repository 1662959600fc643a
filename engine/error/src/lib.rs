//! The one error type. A variant says what a caller can do about it; its fields say what was found where.

use std::path::{Path, PathBuf};

/// Shorthand for results of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Everything that can go wrong, by what the caller can do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A value the caller gave cannot be used: give another.
    #[error("{what}: found {found}, expected {expected}")]
    Argument {
        /// The name of the argument, option or field.
        what: String,
        /// The value that was given.
        found: String,
        /// The values that would have been accepted.
        expected: String,
    },
    /// A file could not be opened, read or written: check the path, the permissions and the space left.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The operating system's reason.
        source: std::io::Error,
    },
    /// A file's bytes are not what its format allows: get the file again or from elsewhere.
    #[error("{}{}: {reason}", path.display(), offset.map(|o| format!(", byte {o}")).unwrap_or_default())]
    Format {
        /// The file.
        path: PathBuf,
        /// Where in the file, when that is known.
        offset: Option<u64>,
        /// The reason: what was found and what was expected there.
        reason: String,
    },
    /// A checkpoint's tensors are not those of its architecture: use the right checkpoint or variant.
    #[error("{}: tensors do not fit {architecture}{}{}{}", path.display(),
        list("missing", missing), list("unexpected", unexpected), list("misshapen", misshapen))]
    Weights {
        /// The checkpoint.
        path: PathBuf,
        /// The architecture that was asked for or found.
        architecture: String,
        /// Names that the architecture needs and the file lacks.
        missing: Vec<String>,
        /// Names that the file has and the architecture does not know.
        unexpected: Vec<String>,
        /// `name: found [..], expected [..]`.
        misshapen: Vec<String>,
    },
    /// No Vulkan device can run this: install a driver or choose another device.
    #[error("no usable Vulkan device: {0}")]
    NoDevice(String),
    /// The device or the host has too little memory; nothing was submitted.
    #[error("{what} needs {needed} bytes, {available} bytes are there")]
    Memory {
        /// The thing that was to be allocated.
        what: String,
        /// Bytes it needs.
        needed: u64,
        /// Bytes that could be had.
        available: u64,
    },
    /// The driver refused a call that should have worked.
    #[error("{call} failed: {result}")]
    Driver {
        /// The Vulkan entry point or library call.
        call: &'static str,
        /// The driver's result code, by name.
        result: String,
    },
    /// The device was lost: what ran on it is gone, and it stays lost. Open it again and repeat.
    #[error(
        "the Vulkan device was lost (reset by its driver, or removed), and what ran on it with it: open it again and \
         repeat; where it is lost again, update its driver or use another"
    )]
    DeviceLost,
    /// The caller's progress callback asked to stop.
    #[error("cancelled")]
    Cancelled,
}

impl Error {
    /// An unusable argument.
    pub fn argument(what: impl Into<String>, found: impl ToString, expected: impl Into<String>) -> Self {
        Self::Argument { what: what.into(), found: found.to_string(), expected: expected.into() }
    }

    /// A file operation that failed.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// A malformed file.
    pub fn format(path: impl AsRef<Path>, offset: Option<u64>, reason: impl Into<String>) -> Self {
        Self::Format { path: path.as_ref().to_path_buf(), offset, reason: reason.into() }
    }
}

fn list(label: &str, names: &[String]) -> String {
    if names.is_empty() { String::new() } else { format!("; {label} ({}): {}", names.len(), names.join(", ")) }
}
