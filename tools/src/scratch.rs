//! Temporary folders; the next run removes those of killed processes.

use std::{
    fs::{File, FileType, TryLockError},
    path::Path,
};
use tempfile::TempDir;
use zipsplat::{Error, Result, types::remove_stale};

/// Unlocked folders with this prefix are removed.
const PREFIX: &str = ".zipsplat-scratch-";

pub struct Scratch {
    folder: TempDir,
    // `None` on systems without folder locks.
    _lock: Option<File>,
}

impl Scratch {
    pub fn new() -> Result<Self> {
        remove_stale(&std::env::temp_dir(), PREFIX, FileType::is_dir, |path| std::fs::remove_dir_all(path));
        loop {
            let folder = tempfile::Builder::new().prefix(PREFIX).tempdir();
            let folder = folder.map_err(|source| Error::io(std::env::temp_dir(), source))?;
            let lock = File::open(folder.path()).ok();
            let locked = lock.as_ref().map(File::try_lock);
            // Another process may have removed it.
            if !matches!(locked, Some(Err(TryLockError::WouldBlock))) && folder.path().exists() {
                return Ok(Self { folder, _lock: lock });
            }
        }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
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
