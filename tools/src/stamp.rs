//! Stamps of inputs, for skipping finished work.

use sha2::{Digest, Sha256};
use std::{fs::File, path::Path, time::SystemTime};
use zipsplat::{Error, Result};

pub fn stamp(path: &Path) -> Result<String> {
    let failed = |error| Error::io(path, error);
    let found = path.metadata().map_err(failed)?;
    let time = found.modified().map_err(failed)?.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Ok(format!("{} {} {}\n", path.file_name().unwrap_or_default().to_string_lossy(), found.len(), time.as_nanos()))
}

/// SHA-256 of a file or of a folder's files; nothing for a name.
pub fn hash_of_weights(weights: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    let mut files = vec![weights.to_owned()];
    if weights.is_dir() {
        let entries = weights.read_dir().map_err(|error| Error::io(weights, error))?;
        files = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
        files.sort();
    }
    for file in files.iter().filter(|file| file.is_file()) {
        let mut file = File::open(file).map_err(|error| Error::io(file, error))?;
        std::io::copy(&mut file, &mut hash).map_err(|error| Error::io(weights, error))?;
    }
    Ok(hex(hash))
}

pub fn digest(parts: &[String]) -> String {
    let mut hash = Sha256::new();
    parts.iter().for_each(|part| hash.update(part));
    hex(hash)
}

fn hex(hash: Sha256) -> String {
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}
