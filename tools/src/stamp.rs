//! Input stamps for skipping finished work.

use sha2::{Digest, Sha256};
use std::{path::Path, time::SystemTime};
use zipsplat::{Error, Result};

pub fn stamp(path: &Path) -> Result<String> {
    let failed = |error| Error::io(path, error);
    let found = path.metadata().map_err(failed)?;
    let time = found.modified().map_err(failed)?.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Ok(format!("{} {} {}\n", path.file_name().unwrap_or_default().to_string_lossy(), found.len(), time.as_nanos()))
}

pub fn stamp_of_weights(weights: &str) -> Result<String> {
    let path = Path::new(weights);
    if path.is_file() { stamp(path) } else { Ok(String::new()) }
}

pub fn digest(parts: &[String]) -> String {
    let mut hash = Sha256::new();
    parts.iter().for_each(|part| hash.update(part));
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}
