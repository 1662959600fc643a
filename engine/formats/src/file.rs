//! Reading of regular files only, and atomic writes.

use std::collections::BTreeSet;
use std::fs::{File, FileType, TryLockError};
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use tempfile::NamedTempFile;

use crate::{Error, Result};

/// Opens a regular file, or a link to one.
///
/// # Errors
/// [`Error::Argument`] for other file types.
pub fn open_file(path: impl AsRef<Path>) -> Result<File> {
    let path = path.as_ref();
    let failed = |source| Error::io(path, source);
    let kind = path.metadata().map_err(failed)?.file_type();
    if !kind.is_file() {
        return Err(Error::argument(path.display().to_string(), kind_of(kind), "a regular file"));
    }
    File::open(path).map_err(failed)
}

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

/// Writes a temporary file and renames it to `path`. Writes directly to other file types, such as
/// pipes and `/dev/stdout`.
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

/// Such files are stale if no process has locked them.
const PREFIX: &str = ".zipsplat-";

fn temporary(path: &Path) -> std::io::Result<NamedTempFile> {
    let folder = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    clean_once(folder);
    loop {
        let file = create_in(folder)?;
        let locked = file.as_file().try_lock();
        // Before it was locked, another process may have taken it for stale.
        if !matches!(locked, Err(TryLockError::WouldBlock)) && file.path().exists() {
            return Ok(file);
        }
    }
}

fn clean_once(folder: &Path) {
    static CLEAN: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    let Ok(whole) = folder.canonicalize() else { return };
    if !CLEAN.lock().unwrap_or_else(PoisonError::into_inner).insert(whole) {
        return;
    }
    remove_stale(folder, PREFIX, FileType::is_file, |path| std::fs::remove_file(path));
}

/// Removes a prefix's unlocked files or folders, as far as possible.
pub fn remove_stale(
    folder: &Path,
    prefix: &str,
    is_kind: fn(&FileType) -> bool,
    remove: fn(&Path) -> std::io::Result<()>,
) {
    for entry in folder.read_dir().into_iter().flatten().flatten() {
        if entry.file_name().to_string_lossy().starts_with(prefix)
            && entry.file_type().is_ok_and(|kind| is_kind(&kind))
            && let Ok(lock) = File::open(entry.path())
            && lock.try_lock().is_ok()
        {
            let _ = remove(&entry.path());
        }
    }
}

fn create_in(folder: &Path) -> std::io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(PREFIX);
    // Temporary files default to owner-only access.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder).map_err(plain)
}

fn plain(error: std::io::Error) -> std::io::Error {
    let words = error.to_string();
    let reason = words.split(" at path ").next().unwrap_or(&words);
    std::io::Error::new(error.kind(), reason)
}

/// A temporary file, deleted unless finished.
pub struct Unfinished {
    file: NamedTempFile,
    path: PathBuf,
}

impl Unfinished {
    /// Creates the temporary file for `path`.
    pub fn begin(path: &Path) -> Result<Self> {
        let file = temporary(path).map_err(|source| Error::io(path, source))?;
        Ok(Self { file, path: path.to_owned() })
    }

    /// Returns an appending writer.
    pub fn writer(&self) -> Result<BufWriter<File>> {
        let file = self.file.as_file().try_clone();
        file.map(BufWriter::new).map_err(|source| Error::io(&self.path, source))
    }

    /// Returns the temporary path.
    pub fn temporary_path(&self) -> &Path {
        self.file.path()
    }

    /// Renames the file to its final path, replacing any existing file.
    pub fn finish(self) -> Result<()> {
        let Self { file, path } = self;
        file.persist(&path).map(drop).map_err(|error| Error::io(path, error.error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn temporary_files_of_killed_processes_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let stale = folder.path().join(".zipsplat-killed");
        let other = folder.path().join("other.ply");
        std::fs::write(&stale, "half").unwrap();
        std::fs::write(&other, "whole").unwrap();
        let live = create_in(folder.path()).unwrap();
        live.as_file().lock().unwrap();
        let begun = Unfinished::begin(&folder.path().join("scene.ply")).unwrap();
        assert!(!stale.exists() && other.exists() && live.path().exists() && begun.temporary_path().exists());
        begun.finish().unwrap();
        assert!(folder.path().join("scene.ply").exists());
    }
}
