//! Stamps of inputs, for skipping finished work.

use sha2::{Digest, Sha256};
use std::{
    fs::File,
    path::{Path, PathBuf},
    time::SystemTime,
};
use zipsplat::{Error, Result};

/// Name, size and time of a file, or of a folder's files.
pub fn stamp(path: &Path) -> Result<String> {
    if path.is_dir() {
        return files_in(path)?.iter().map(|file| stamp(file)).collect();
    }
    let failed = |error| Error::io(path, error);
    let found = path.metadata().map_err(failed)?;
    let time = found.modified().map_err(failed)?.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Ok(format!("{} {} {}\n", path.file_name().unwrap_or_default().to_string_lossy(), found.len(), time.as_nanos()))
}

/// SHA-256 of a file or of a folder's files; nothing for a name.
pub fn hash_of_weights(weights: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    let files = if weights.is_dir() { files_in(weights)? } else { vec![weights.to_owned()] };
    for file in files.iter().filter(|file| file.is_file()) {
        let mut file = File::open(file).map_err(|error| Error::io(file, error))?;
        std::io::copy(&mut file, &mut hash).map_err(|error| Error::io(weights, error))?;
    }
    Ok(hex(hash))
}

fn files_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = folder.read_dir().map_err(|error| Error::io(folder, error))?;
    let mut files: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    files.retain(|file| file.is_file());
    files.sort();
    Ok(files)
}

pub fn digest(parts: &[String]) -> String {
    let mut hash = Sha256::new();
    parts.iter().for_each(|part| hash.update(part));
    hex(hash)
}

fn hex(hash: Sha256) -> String {
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}
