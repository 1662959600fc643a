//! Stamps of inputs, for skipping finished work.

use sha2::{Digest, Sha256};
use std::{
    fs::File,
    path::{Path, PathBuf},
    time::SystemTime,
};
use zipsplat::{Error, Result};

/// Name, size and time of a file, or of the files in a folder and below, except behind links.
pub fn stamp(path: &Path) -> Result<String> {
    if path.is_dir() {
        let entries = entries(path)?.into_iter().filter(|entry| entry.is_file() || !entry.is_symlink());
        return entries.map(|entry| stamp(&entry)).collect();
    }
    let failed = |error| Error::io(path, error);
    let found = path.metadata().map_err(failed)?;
    let time = found.modified().map_err(failed)?.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Ok(format!("{} {} {}\n", path.file_name().unwrap_or_default().to_string_lossy(), found.len(), time.as_nanos()))
}

/// SHA-256 of a file or of a folder's files; nothing for a name.
pub fn hash_of_weights(weights: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    let files = if weights.is_dir() { entries(weights)? } else { vec![weights.to_owned()] };
    for file in files.iter().filter(|file| file.is_file()) {
        let mut file = File::open(file).map_err(|error| Error::io(file, error))?;
        std::io::copy(&mut file, &mut hash).map_err(|error| Error::io(weights, error))?;
    }
    Ok(hex(&hash.finalize()))
}

/// Paths in a folder, sorted.
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let failed = |error| Error::io(folder, error);
    let entries = folder.read_dir().map_err(failed)?.map(|entry| Ok(entry.map_err(failed)?.path()));
    let mut entries = entries.collect::<Result<Vec<_>>>()?;
    entries.sort();
    Ok(entries)
}

pub fn digest(parts: &[String]) -> String {
    let mut hash = Sha256::new();
    parts.iter().for_each(|part| hash.update(part));
    hex(&hash.finalize())
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn stamps_cover_folders_below() {
        let folder = tempfile::TempDir::new().unwrap();
        let model = folder.path().join("sparse/0");
        fs::create_dir_all(&model).unwrap();
        let mut stamps = Vec::new();
        for text in ["a", "longer"] {
            fs::write(model.join("images.txt"), text).unwrap();
            stamps.push(stamp(folder.path()).unwrap());
        }
        assert_ne!(stamps[0], stamps[1]);
    }
}
