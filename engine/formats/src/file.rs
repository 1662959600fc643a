//! Files that are read only where they are files, and written whole or not at all.

use std::fs::{File, FileType};
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::{Error, Result};

/// Opens a file for reading, and nothing else: opening a pipe waits for who may never write, and a device may have no end.
/// A link to a regular file is one.
///
/// # Errors
/// [`Error::Io`] naming `path`; [`Error::Argument`] when it is no regular file.
pub fn open_file(path: impl AsRef<Path>) -> Result<File> {
    let path = path.as_ref();
    let failed = |source| Error::io(path, source);
    let kind = path.metadata().map_err(failed)?.file_type();
    if !kind.is_file() {
        return Err(Error::argument(path.display().to_string(), kind_of(kind), "a regular file"));
    }
    File::open(path).map_err(failed)
}

/// The bytes of a file, as [`open_file`] opens it.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>> {
    let (mut file, mut bytes) = (open_file(path)?, Vec::new());
    file.read_to_end(&mut bytes).map_err(|source| Error::io(path, source))?;
    Ok(bytes)
}

fn kind_of(kind: FileType) -> &'static str {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        match () {
            () if kind.is_fifo() => return "a pipe",
            () if kind.is_socket() => return "a socket",
            () if kind.is_char_device() || kind.is_block_device() => return "a device",
            () => {}
        }
    }
    if kind.is_dir() { "a folder" } else { "something else" }
}

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
    let mut out = BufWriter::new(temporary(path)?);
    write(&mut out)?;
    out.into_inner()?.persist(path)?;
    Ok(())
}

fn temporary(path: &Path) -> std::io::Result<NamedTempFile> {
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    builder.prefix(".zipsplat-");
    // Without this the file would keep a temporary file's mode and nobody but its owner could read it.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder).map_err(plain)
}

/// An error without the temporary name, which nobody can do anything about; it is in the error's words alone.
fn plain(error: std::io::Error) -> std::io::Error {
    let words = error.to_string();
    let reason = words.split(" at path ").next().unwrap_or(&words);
    std::io::Error::new(error.kind(), reason)
}

/// A file in the making, under a temporary name beside its own; gone unless it is finished.
pub struct Unfinished {
    file: NamedTempFile,
    path: PathBuf,
}

impl Unfinished {
    /// Begins what will be at `path`.
    ///
    /// # Errors
    /// [`Error::Io`] naming `path`.
    pub fn begin(path: &Path) -> Result<Self> {
        let file = temporary(path).map_err(|source| Error::io(path, source))?;
        Ok(Self { file, path: path.to_owned() })
    }

    /// Writes to it, from where the last writer stopped.
    ///
    /// # Errors
    /// [`Error::Io`] naming the file.
    pub fn writer(&self) -> Result<BufWriter<File>> {
        let file = self.file.as_file().try_clone();
        file.map(BufWriter::new).map_err(|source| Error::io(&self.path, source))
    }

    /// Where it is until it is finished.
    pub fn temporary_path(&self) -> &Path {
        self.file.path()
    }

    /// Gives it its own name, in place of the file that had it.
    ///
    /// # Errors
    /// [`Error::Io`] naming the file.
    pub fn finish(self) -> Result<()> {
        let Self { file, path } = self;
        file.persist(&path).map(drop).map_err(|error| Error::io(path, error.error))
    }
}
