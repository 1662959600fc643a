//! The engine's error type.

use std::path::{Path, PathBuf};

/// Result with this crate's error.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Errors, by the caller's possible reaction.
#[non_exhaustive]
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// An invalid argument: pass another value.
    #[error("{what}: found {found}, expected {expected}")]
    Argument {
        /// Argument, option or field.
        what: String,
        /// Rejected value.
        found: String,
        /// Accepted values.
        expected: String,
    },
    /// A failed file operation: check path, permissions and free space.
    #[error("{}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// A malformed file: get the file again or elsewhere.
    #[error("{}{}: {reason}", path.display(), offset.map(|o| format!(", byte {o}")).unwrap_or_default())]
    Format {
        /// File.
        path: PathBuf,
        /// Byte offset in the file, if known.
        offset: Option<u64>,
        /// Found and expected content.
        reason: String,
    },
    /// A checkpoint that does not match its architecture: use the right checkpoint or variant.
    #[error("{}: tensors do not fit {architecture}{}{}{}", path.display(),
        list("missing", missing), list("unexpected", unexpected), list("misshapen", misshapen))]
    Weights {
        /// Checkpoint.
        path: PathBuf,
        /// Requested or detected architecture.
        architecture: String,
        /// Tensors missing from the file.
        missing: Vec<String>,
        /// Tensors unknown to the architecture.
        unexpected: Vec<String>,
        /// `name: found [..], expected [..]`.
        misshapen: Vec<String>,
    },
    /// No usable Vulkan device: install a driver or choose another device.
    #[error("no usable Vulkan device: {0}")]
    NoDevice(String),
    /// Too little device or host memory; nothing was submitted.
    #[error("{what} needs {needed} bytes, {available} bytes are there")]
    Memory {
        /// Allocation.
        what: String,
        /// Required bytes.
        needed: u64,
        /// Available bytes.
        available: u64,
    },
    /// An unexpected driver failure.
    #[error("{call} failed: {result}")]
    Driver {
        /// Vulkan function or library call.
        call: &'static str,
        /// Result code.
        result: String,
    },
    /// Device loss, which is permanent: reopen the device and repeat all work.
    #[error(
        "the Vulkan device was lost (reset by its driver, or removed), and what ran on it with it: open it again and \
         repeat; where it is lost again, update its driver or use another"
    )]
    DeviceLost,
    /// Cancellation by the caller's progress callback.
    #[error("cancelled")]
    Cancelled,
}

impl Error {
    /// Creates [`Error::Argument`].
    pub fn argument(what: impl Into<String>, found: impl ToString, expected: impl Into<String>) -> Self {
        Self::Argument { what: what.into(), found: found.to_string(), expected: expected.into() }
    }

    /// Creates [`Error::Io`].
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_path_buf(), source }
    }

    /// Creates [`Error::Format`].
    pub fn format(path: impl AsRef<Path>, offset: Option<u64>, reason: impl Into<String>) -> Self {
        Self::Format { path: path.as_ref().to_path_buf(), offset, reason: reason.into() }
    }
}

fn list(label: &str, names: &[String]) -> String {
    if names.is_empty() { String::new() } else { format!("; {label} ({}): {}", names.len(), names.join(", ")) }
}
