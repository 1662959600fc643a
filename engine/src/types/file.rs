//! Files that are written whole or not at all.

use std::io::{BufWriter, Write};
use std::path::Path;

use crate::{Error, Result};

/// Writes to a temporary file beside `path` and renames it: a reader sees the old file or the new one, and a failure
/// leaves the old one. What is not a regular file (a pipe, `/dev/stdout`) cannot be replaced and is written straight.
///
/// # Errors
/// [`Error::Io`] naming `path`.
pub fn write_atomic(path: &Path, write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> Result<()> {
    let special = path.metadata().is_ok_and(|found| !found.is_file());
    let written = if special { write_through(path, write) } else { write_beside(path, write) };
    written.map_err(|source| Error::io(path, source))
}

fn write_through(path: &Path, write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> std::io::Result<()> {
    let mut out = BufWriter::new(std::fs::OpenOptions::new().write(true).open(path)?);
    write(&mut out)?;
    out.flush()
}

fn write_beside(path: &Path, write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> std::io::Result<()> {
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    builder.prefix(".zipsplat-");
    // Without this the file would keep a temporary file's mode and nobody but its owner could read it.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut out = BufWriter::new(builder.tempfile_in(folder)?);
    write(&mut out)?;
    out.into_inner()?.persist(path)?;
    Ok(())
}
