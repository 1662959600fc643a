//! `torch.save` archives: a pickle and a zip entry per storage.

use std::collections::HashMap;
use std::io::{self, Cursor};
use std::ops::Range;
use std::path::Path;

use zip::{CompressionMethod, ZipArchive};

use super::contents::{Conf, Contents, add, bare, is_image_size};
use super::pickle::{Id, Object, Pickle, Tensor};
use super::tensor::{Stored, StoredDtype};
use crate::{Error, Result};

/// The largest variant needs 0.2 million.
const MAX_PICKLE: usize = 1 << 24;
const MAX_LAYERS: usize = 256;
const MODEL: [&str; 2] = ["model", "state_dict"];

pub(super) fn is_archive(file: &[u8]) -> bool {
    file.starts_with(b"PK\x03\x04")
}

pub(super) fn contents(path: &Path, file: &[u8]) -> Result<Contents> {
    let malformed = |reason: String| Error::format(path, None, reason);
    let (mut archive, pickle) = open(path, file)?;
    let (conf, image_size) = conf(&pickle).map_err(|reason| malformed(format!("data.pkl: conf: {reason}")))?;
    let mut found = Contents { conf, image_size, ..Contents::default() };
    for (name, tensor) in tensors(&pickle).map_err(|reason| malformed(format!("data.pkl: {reason}")))? {
        add(&mut found.tensors, name, archive.locate(tensor)).map_err(malformed)?;
    }
    Ok(found)
}

/// Returns the names of the tensors, without reading their values.
pub(super) fn names(path: &Path, file: &[u8]) -> Result<Vec<String>> {
    let (_, pickle) = open(path, file)?;
    let tensors = tensors(&pickle).map_err(|reason| Error::format(path, None, format!("data.pkl: {reason}")))?;
    Ok(tensors.into_iter().map(|(name, _)| bare(name)).collect())
}

fn open<'a>(path: &Path, file: &'a [u8]) -> Result<(Archive<'a>, Pickle<'a>)> {
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
    Ok((archive, pickle))
}

fn tensors<'a>(pickle: &'a Pickle<'_>) -> Result<Vec<(&'a str, &'a Tensor<'a>)>, String> {
    let holder = MODEL.iter().find_map(|key| pickle.entries(pickle.get(pickle.root, key)?));
    let is_tensor = |&&(_, value): &&(Id, Id)| matches!(pickle.object(value), Object::Tensor(_));
    let bare = || pickle.entries(pickle.root).map(|all| all.iter().filter(is_tensor).collect::<Vec<_>>());
    let model = holder.map(|all| all.iter().collect()).or_else(bare).filter(|model: &Vec<_>| !model.is_empty());
    let model = model.ok_or("found no dictionary `model`, nor tensors in its place")?;
    let tensor = |&(key, value): &(Id, Id)| match (pickle.text(key), pickle.object(value)) {
        (Some(name), Object::Tensor(tensor)) => Ok((name, &**tensor)),
        (name, _) => Err(format!("an entry of `model` is no named tensor: {name:?}")),
    };
    model.into_iter().map(tensor).collect()
}

/// Optional settings; the reference nests those of backbone and head.
fn conf(pickle: &Pickle) -> Result<(Conf, Option<u32>), String> {
    let Some(conf) = pickle.get(pickle.root, "conf") else { return Ok(Default::default()) };
    let model = pickle.get(conf, "model").unwrap_or(conf);
    let places = ["backbone", "gaussian_head"].map(|part| pickle.get(model, part));
    let places: Vec<Id> = places.into_iter().flatten().chain([model]).collect();
    let entry = |key: &str| places.iter().find_map(|&place| pickle.get(place, key));
    let size = |key: &str| match entry(key) {
        Some(id) => pickle.size(id).map(Some).ok_or_else(|| format!("{key} is no whole number from 0 on")),
        None => Ok(None),
    };
    for role in ["clustering_layer", "scene_init_layer"] {
        if let Some(layer @ 1..) = size(role)? {
            return Err(format!("{role}: found {layer}, expected 0, the deepest layer"));
        }
    }
    let out_layers =
        entry("out_layers").map(|id| pickle.sizes(id, MAX_LAYERS).ok_or("out_layers is no list of blocks"));
    let without_rope = entry("rope_start").and_then(|id| pickle.int(id)) == Some(-1);
    let found = Conf {
        vit_name: entry("vit_name").and_then(|id| pickle.text(id)).map(String::from),
        out_layers: out_layers.transpose()?,
        alt_start: size("alt_start")?,
        rope_start: if without_rope { Some(usize::MAX) } else { size("rope_start")? },
        gaussians_per_token: size("gaussians_per_prototype")?.or(size("gaussians_per_token")?),
        sh_degree: size("sh_degree")?,
        camera_heads: None,
    };
    let side = entry("img_size").and_then(|id| pickle.size(id)?.try_into().ok()).filter(|side| is_image_size(*side));
    Ok((found, side))
}

struct Archive<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    root: String,
    unclaimed: usize,
    length: usize,
    storages: HashMap<String, Range<usize>>,
}

impl<'a> Archive<'a> {
    fn open(file: &'a [u8]) -> Result<Self, String> {
        let zip = ZipArchive::new(Cursor::new(file)).map_err(|error| format!("zip archive: {error}"))?;
        let root = zip.file_names().find_map(|name| name.strip_suffix("data.pkl"));
        let root = root.ok_or("the zip archive has no entry data.pkl: found no PyTorch checkpoint")?.to_string();
        let mut archive = Self { zip, root, unclaimed: file.len(), length: file.len(), storages: HashMap::new() };
        // Missing before PyTorch 2.1, little-endian in practice.
        if archive.zip.index_for_name(&format!("{}byteorder", archive.root)).is_some() {
            let range = archive.entry("byteorder")?;
            let found = String::from_utf8_lossy(&file[range]);
            if found != "little" {
                return Err(format!("byteorder: found {found:?}, expected little"));
            }
        }
        Ok(archive)
    }

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
            "DoubleStorage" => StoredDtype::F64,
            "FloatStorage" => StoredDtype::F32,
            "HalfStorage" => StoredDtype::F16,
            "BFloat16Storage" => StoredDtype::Bf16,
            other => return Err(format!("found torch.{other}, expected Double-, Float-, Half- or BFloat16Storage")),
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
