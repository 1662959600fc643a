//! The zip archives of `torch.save`: a pickle that describes tensors, and an uncompressed entry for each storage.

use std::collections::HashMap;
use std::io::{self, Cursor};
use std::ops::Range;
use std::path::Path;

use zip::{CompressionMethod, ZipArchive};

use super::Dtype;
use super::contents::{Conf, Contents, add};
use super::pickle::{Object, Pickle, Tensor};
use super::tensor::Stored;
use crate::{Error, Result};

/// Bytes of the largest pickle that is read; that of the largest variant has 0.2 million.
const MAX_PICKLE: usize = 1 << 24;
const MAX_LAYERS: usize = 256;

/// Whether a file begins as zip archives do.
pub(super) fn is_archive(file: &[u8]) -> bool {
    file.starts_with(b"PK\x03\x04")
}

/// Finds the tensors of the entry `model`; [`Error::Format`] where archive or pickle are not as `torch.save` writes.
pub(super) fn contents(path: &Path, file: &[u8]) -> Result<Contents> {
    let malformed = |reason: String| Error::format(path, None, reason);
    let mut archive = Archive::open(file).map_err(malformed)?;
    let pickle_bytes = archive.entry("data.pkl").map_err(malformed)?;
    if pickle_bytes.len() > MAX_PICKLE {
        let found = pickle_bytes.len();
        return Err(malformed(format!("data.pkl: found {found} bytes, expected at most {MAX_PICKLE}")));
    }
    let pickle = Pickle::load(&file[pickle_bytes.clone()]).map_err(|error| {
        let offset = pickle_bytes.start + error.offset;
        Error::format(path, Some(offset as u64), format!("data.pkl: {}", error.reason))
    })?;

    let model = pickle.get(pickle.root, "model").and_then(|model| pickle.entries(model));
    let model = model.ok_or_else(|| malformed("data.pkl: found no dictionary `model`".into()))?;
    let mut found = Contents { conf: conf(&pickle), ..Contents::default() };
    for &(key, value) in model {
        let (Some(name), Object::Tensor(tensor)) = (pickle.text(key), pickle.object(value)) else {
            return Err(malformed(format!("data.pkl: an entry of `model` is no named tensor: {:?}", pickle.text(key))));
        };
        add(&mut found.tensors, name, archive.locate(tensor)).map_err(malformed)?;
    }
    Ok(found)
}

/// What the training configuration says about the network; absent entries are not an error.
fn conf(pickle: &Pickle) -> Conf {
    let Some(conf) = pickle.get(pickle.root, "conf") else { return Conf::default() };
    let model = pickle.get(conf, "model").unwrap_or(conf);
    let entry = |key| pickle.get(model, key);
    Conf {
        vit_name: entry("vit_name").and_then(|id| pickle.text(id)).map(String::from),
        out_layers: entry("out_layers").and_then(|id| pickle.sizes(id, MAX_LAYERS)),
        gaussians_per_token: entry("gaussians_per_token").and_then(|id| pickle.size(id)),
        sh_degree: entry("sh_degree").and_then(|id| pickle.size(id)),
    }
}

struct Archive<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// Folder of all entries, with its slash.
    root: String,
    /// Bytes of the file not yet taken by an entry: entries that overlap would run out of them.
    unclaimed: usize,
    length: usize,
    /// Where the storages lie that were looked at.
    storages: HashMap<String, Range<usize>>,
}

impl<'a> Archive<'a> {
    fn open(file: &'a [u8]) -> Result<Self, String> {
        let zip = ZipArchive::new(Cursor::new(file)).map_err(|error| format!("zip archive: {error}"))?;
        let root = zip.file_names().find_map(|name| name.strip_suffix("data.pkl"));
        let root = root.ok_or("the zip archive has no entry data.pkl: found no PyTorch checkpoint")?.to_string();
        let mut archive = Self { zip, root, unclaimed: file.len(), length: file.len(), storages: HashMap::new() };
        // Absent in archives of PyTorch before 2.1, which were little-endian on every machine that matters.
        if archive.zip.index_for_name(&format!("{}byteorder", archive.root)).is_some() {
            let range = archive.entry("byteorder")?;
            let found = String::from_utf8_lossy(&file[range]);
            if found != "little" {
                return Err(format!("byteorder: found {found:?}, expected little"));
            }
        }
        Ok(archive)
    }

    /// The bytes of an entry, its checksum verified.
    fn entry(&mut self, name: &str) -> Result<Range<usize>, String> {
        let full = format!("{}{name}", self.root);
        let context = |reason: String| format!("{name}: {reason}");
        let mut entry = self.zip.by_name(&full).map_err(|error| context(error.to_string()))?;
        if entry.compression() != CompressionMethod::Stored || entry.size() != entry.compressed_size() {
            return Err(context(format!("found compression {}, expected none", entry.compression())));
        }
        let range = usize::try_from(entry.data_start()).ok().zip(usize::try_from(entry.size()).ok());
        let range = range.and_then(|(start, size)| Some(start..start.checked_add(size)?));
        let range = range.filter(|range| range.end <= self.length && range.len() <= self.unclaimed);
        let range = range.ok_or_else(|| context("reaches beyond the file or into other entries".into()))?;
        io::copy(&mut entry, &mut io::sink()).map_err(|error| context(error.to_string()))?;
        self.unclaimed -= range.len();
        Ok(range)
    }

    fn locate(&mut self, tensor: &Tensor) -> Result<Stored, String> {
        let storage = tensor.storage;
        let dtype = match storage.kind {
            "FloatStorage" => Dtype::F32,
            "HalfStorage" => Dtype::F16,
            "BFloat16Storage" => Dtype::Bf16,
            other => return Err(format!("found torch.{other}, expected Float-, Half- or BFloat16Storage")),
        };
        let range = match self.storages.get(storage.key) {
            Some(range) => range.clone(),
            None => {
                let range = self.entry(&format!("data/{}", storage.key))?;
                self.storages.insert(storage.key.into(), range.clone());
                range
            }
        };
        if storage.elements.checked_mul(dtype.size()) != Some(range.len()) {
            let (key, bytes, elements) = (storage.key, range.len(), storage.elements);
            return Err(format!("data/{key}: found {bytes} bytes, expected {elements} {} values", dtype.name()));
        }
        let start = tensor.offset.checked_mul(dtype.size()).and_then(|skipped| skipped.checked_add(range.start));
        let start = start.ok_or_else(|| format!("offset {} lies beyond its data", tensor.offset))?;
        Stored::new(dtype, tensor.shape.clone(), tensor.strides.clone(), start, range.end)
    }
}
