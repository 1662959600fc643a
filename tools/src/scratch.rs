//! Temporary folders, which the next run removes after a process that was killed.

use std::{
    fs::{File, TryLockError},
    path::Path,
};
use tempfile::TempDir;
use zipsplat::{Error, Result};

/// Start of the folders' names: whatever is called so is removed unless it is locked.
const PREFIX: &str = ".zipsplat-scratch-";

/// A temporary folder that is locked as long as its process lives.
pub struct Scratch {
    folder: TempDir,
    // None on systems that do not lock folders; nothing is removed there.
    _lock: Option<File>,
}

impl Scratch {
    /// Makes an empty folder.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn new() -> Result<Self> {
        remove_stale(&std::env::temp_dir());
        loop {
            let folder = tempfile::Builder::new().prefix(PREFIX).tempdir();
            let folder = folder.map_err(|source| Error::io(std::env::temp_dir(), source))?;
            let lock = File::open(folder.path()).ok();
            let locked = lock.as_ref().map(File::try_lock);
            // Another process may have removed it before it was locked.
            if !matches!(locked, Some(Err(TryLockError::WouldBlock))) && folder.path().exists() {
                return Ok(Self { folder, _lock: lock });
            }
        }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// Removes the folders of processes that no longer live.
fn remove_stale(within: &Path) {
    for entry in within.read_dir().into_iter().flatten().flatten() {
        let is_scratch = entry.file_name().to_string_lossy().starts_with(PREFIX);
        if is_scratch
            && entry.file_type().is_ok_and(|kind| kind.is_dir())
            && let Ok(lock) = File::open(entry.path())
            && lock.try_lock().is_ok()
        {
            // Folders of other users stay.
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_dead_processes_are_removed() {
        let stale = tempfile::Builder::new().prefix(PREFIX).tempdir().unwrap().keep();
        std::fs::write(stale.join("database.db"), "").unwrap();
        let [first, second] = [Scratch::new().unwrap(), Scratch::new().unwrap()];
        assert!(!stale.exists() && first.path().is_dir() && second.path().is_dir());
        let path = first.path().to_owned();
        drop(first);
        assert!(!path.exists() && second.path().is_dir());
    }
}
