use std::path::Path;

use safetensors::Dtype as FileDtype;
use safetensors::tensor::{Metadata, TensorInfo};

use super::contents::{Contents, MAX_IMAGE_SIZE, add, is_image_size};
use super::tensor::{Stored, StoredDtype};
use super::{Architecture, DepthArchitecture, Dtype};
use crate::types::preprocess::PATCH;
use crate::{Error, Result};

pub(super) const ARCHITECTURE_KEY: &str = "zipsplat.architecture";
pub(super) const DEPTH_ARCHITECTURE_KEY: &str = "zipsplat.depth_architecture";
pub(super) const IMAGE_SIZE_KEY: &str = "zipsplat.image_size";
/// Its name in files without a version.
const PICTURE_SIDE_KEY: &str = "zipsplat.picture_side";
pub(super) const VERSION_KEY: &str = "zipsplat.format_version";
pub(super) const VERSION: u32 = 1;
pub(super) const Q8_ENDS: [&str; 2] = [".q8", ".q8_scales"];
pub(super) const PREFIX: usize = 8;
const MAX_HEADER: u64 = 100_000_000;
const EXPECTED: &str = "expected safetensors or a zip archive of torch.save";

pub(super) fn contents(path: &Path, file: &[u8]) -> Result<Contents> {
    let malformed = |reason: String| Error::format(path, None, reason);
    let length = file.first_chunk::<PREFIX>().map(|bytes| u64::from_le_bytes(*bytes));
    let size = file.len();
    let length = length.ok_or_else(|| malformed(format!("found {size} bytes, {EXPECTED}")))?;
    if length > MAX_HEADER || length > (size - PREFIX) as u64 {
        let found = format!("found a safetensors header of {length} bytes in a file of {size} bytes");
        return Err(malformed(format!("{found}, {EXPECTED}")));
    }
    let start = PREFIX + length as usize;
    let header: Metadata = serde_json::from_slice(&file[PREFIX..start])
        .map_err(|error| malformed(format!("safetensors header: {error}")))?;
    if header.data_len() != file.len() - start {
        let (found, expected) = (file.len() - start, header.data_len());
        return Err(malformed(format!("found {found} bytes of values, the header expects {expected}")));
    }

    let mut found = Contents::default();
    let infos = header.tensors();
    for (name, info) in &infos {
        let [integers, scales] = Q8_ENDS.map(|end| name.strip_suffix(end));
        if scales.is_some_and(|name| infos.contains_key(&format!("{name}{}", Q8_ENDS[0]))) {
            continue;
        }
        let mut tensor = stored(info, integers.is_some(), start);
        if let Some(name) = integers {
            let beside = infos.get(&format!("{name}{}", Q8_ENDS[1])).ok_or("found no scales beside it".to_owned());
            let scales = beside.and_then(|info| stored(info, false, start));
            tensor = tensor.and_then(|tensor| tensor.with_scales(&scales?));
        }
        add(&mut found.tensors, integers.unwrap_or(name), tensor).map_err(malformed)?;
    }
    let stated = |key: &str| header.metadata().as_ref().and_then(|metadata| metadata.get(key));
    if let Some(version) = stated(VERSION_KEY)
        && version.parse().ok().is_none_or(|version: u32| version > VERSION)
    {
        return Err(malformed(format!("{VERSION_KEY}: found {version}, expected at most {VERSION}; update zipsplat")));
    }
    if let Some(side) = stated(IMAGE_SIZE_KEY).or(stated(PICTURE_SIDE_KEY)) {
        let parsed = side.parse().ok().filter(|side| is_image_size(*side));
        let expected = format!("a multiple of {PATCH} up to {MAX_IMAGE_SIZE}");
        let side = parsed.ok_or_else(|| malformed(format!("{IMAGE_SIZE_KEY}: found {side}, expected {expected}")))?;
        found.image_size = Some(side);
    }
    if let Some(json) = stated(ARCHITECTURE_KEY) {
        let architecture: Architecture =
            serde_json::from_str(json).map_err(|error| malformed(format!("{ARCHITECTURE_KEY}: {error}")))?;
        architecture.validate().map_err(|error| malformed(format!("{ARCHITECTURE_KEY}: {error}")))?;
        found.architecture = Some(architecture);
    }
    if let Some(json) = stated(DEPTH_ARCHITECTURE_KEY) {
        let architecture: DepthArchitecture =
            serde_json::from_str(json).map_err(|error| malformed(format!("{DEPTH_ARCHITECTURE_KEY}: {error}")))?;
        architecture.validate().map_err(|error| malformed(format!("{DEPTH_ARCHITECTURE_KEY}: {error}")))?;
        found.depth_architecture = Some(architecture);
    }
    Ok(found)
}

fn stored(info: &TensorInfo, integers: bool, start: usize) -> Result<Stored, String> {
    let dtype = match info.dtype {
        FileDtype::F64 if !integers => StoredDtype::F64,
        FileDtype::F32 if !integers => StoredDtype::F32,
        FileDtype::F16 if !integers => StoredDtype::F16,
        FileDtype::BF16 if !integers => StoredDtype::Bf16,
        FileDtype::I8 if integers => StoredDtype::I8,
        other if integers => return Err(format!("found type {other}, expected I8")),
        other => return Err(format!("found type {other}, expected F64, F32, F16 or BF16")),
    };
    let (from, to) = info.data_offsets;
    Stored::dense(dtype, info.shape.clone(), start + from, start + to)
}

pub(super) fn too_small(dtype: Dtype, name: &str, value: f32) -> Error {
    let found = format!("{}, too small for {value} in {name}", dtype.name());
    Error::argument("dtype", found, "a type that holds every value")
}
