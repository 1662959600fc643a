use super::POLL;
use crate::{session::Stage, stamp::hex};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::{
    fs::{File, OpenOptions, TryLockError},
    io::{self, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};
use zipsplat::{Error, Result, types::write_atomic};

const BLOCK: usize = 1 << 20;
/// Digits of the hash in a file name.
pub const TAG: usize = 12;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Promise {
    pub url: String,
    pub size: u64,
    /// Lowercase hexadecimal.
    pub sha256: String,
}

impl Promise {
    pub fn path(&self, base: &Path) -> PathBuf {
        let part = |part: Option<&std::ffi::OsStr>| part.unwrap_or_default().to_string_lossy().into_owned();
        base.with_file_name(format!("{}-{}.{}", part(base.file_stem()), &self.sha256[..TAG], part(base.extension())))
    }
}

/// Bytes so far (`BASE.part`) and [`Promise`] (`BASE.part.json`).
pub struct Partial {
    path: PathBuf,
    promise_path: PathBuf,
    base: PathBuf,
    file: File,
    promise: Promise,
}

/// Cross-process lock on a file's download and conversion.
pub struct Lock {
    path: PathBuf,
    _file: File,
}

impl Lock {
    pub fn new(base: &Path, stage: &Stage<'_>) -> Result<Self> {
        let [.., path] = paths(base);
        let failed = |error| Error::io(&path, error);
        loop {
            let file = open(&path)?;
            loop {
                match file.try_lock() {
                    Ok(()) => break,
                    Err(TryLockError::WouldBlock) => stage.check()?,
                    // Network folders may have no locks.
                    Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => break,
                    Err(TryLockError::Error(error)) => return Err(failed(error)),
                }
                std::thread::sleep(POLL);
            }
            // Others may have removed and recreated the file.
            if is_at(&file, &path).map_err(failed)? {
                return Ok(Self { path, _file: file });
            }
        }
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

fn is_at(file: &File, path: &Path) -> io::Result<bool> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let identity = |found: std::fs::Metadata| (found.dev(), found.ino());
        let there = path.symlink_metadata().map(identity);
        Ok(there.is_ok_and(|there| file.metadata().is_ok_and(|found| identity(found) == there)))
    }
    #[cfg(not(unix))]
    file.metadata().and_then(|_| path.try_exists())
}

/// Follows no links.
fn open(path: &Path) -> Result<File> {
    let mut options = OpenOptions::new();
    options.create(true).truncate(false).read(true).write(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, rustix::fs::OFlags::NOFOLLOW.bits() as i32);
    options.open(path).map_err(|error| {
        if path.is_symlink() {
            Error::format(path, None, "a symbolic link, expected a regular file")
        } else {
            Error::io(path, error)
        }
    })
}

fn paths(base: &Path) -> [PathBuf; 3] {
    [".part", ".part.json", ".lock"].map(|ending| {
        let mut name = base.as_os_str().to_owned();
        name.push(ending);
        name.into()
    })
}

pub fn kept(base: &Path) -> Option<(u64, Promise)> {
    let [path, promise, _] = paths(base);
    Some((path.metadata().ok()?.len(), serde_json::from_slice(&std::fs::read(promise).ok()?).ok()?))
}

impl Partial {
    /// The caller holds the [`Lock`]. Drops bytes of another promise.
    pub fn open(base: &Path, promise: &Promise) -> Result<Self> {
        let [path, promise_path, _] = paths(base);
        let goes_on =
            kept(base).is_some_and(|(_, known)| (known.size, known.sha256) == (promise.size, promise.sha256.clone()));
        let file = open(&path)?;
        if !goes_on {
            file.set_len(0).map_err(|error| Error::io(&path, error))?;
        }
        write_atomic(&promise_path, |out| Ok(serde_json::to_writer_pretty(out, promise)?))?;
        Ok(Self { path, promise_path, base: base.to_owned(), file, promise: promise.clone() })
    }

    pub fn length(&self) -> Result<u64> {
        self.file.metadata().map(|found| found.len()).map_err(|error| Error::io(&self.path, error))
    }

    /// `start` is at most the file's length.
    pub fn write(&mut self, start: u64, bytes: &[u8]) -> Result<()> {
        let written = self.file.seek(SeekFrom::Start(start)).and_then(|_| self.file.write_all(bytes));
        written.map_err(|error| Error::io(&self.path, error))
    }

    pub fn clear(&mut self) -> Result<()> {
        self.file.set_len(0).map_err(|error| Error::io(&self.path, error))
    }

    /// Removes the file if its hash is wrong.
    pub fn finish(mut self, stage: &Stage<'_>) -> Result<()> {
        let found = self.hash(stage)?;
        let Self { path, promise_path, base, file, promise } = self;
        let failed = |error| Error::io(&path, error);
        if found != promise.sha256 {
            std::fs::remove_file(&path).map_err(failed)?;
            let _ = std::fs::remove_file(promise_path);
            let reason =
                format!("SHA-256: found {found}, expected {}; what came is removed, get it again", promise.sha256);
            return Err(Error::format(&promise.url, None, reason));
        }
        file.sync_all().map_err(failed)?;
        std::fs::rename(&path, promise.path(&base)).map_err(failed)?;
        let _ = std::fs::remove_file(promise_path);
        Ok(())
    }

    fn hash(&mut self, stage: &Stage<'_>) -> Result<String> {
        let (mut hasher, mut block, mut done) = (Sha256::new(), vec![0; BLOCK], 0);
        self.file.seek(SeekFrom::Start(0)).map_err(|error| Error::io(&self.path, error))?;
        loop {
            let read = self.file.read(&mut block).map_err(|error| Error::io(&self.path, error))?;
            if read == 0 {
                return Ok(hex(&hasher.finalize()));
            }
            hasher.update(&block[..read]);
            done += read as u64;
            stage.reach(done as f64 / self.promise.size.max(1) as f64)?;
        }
    }
}
