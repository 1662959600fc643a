use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::Path;

use half::{bf16, f16};
use safetensors::Dtype as FileDtype;
use safetensors::tensor::{Metadata, TensorInfo};

use super::contents::{Contents, MAX_IMAGE_SIZE, add, is_image_size};
use super::tensor::{Stored, StoredDtype};
use super::values::Values;
use super::{Architecture, DepthArchitecture, Dtype};
use crate::ops::Q8;
use crate::types::{Unfinished, preprocess::PATCH};
use crate::{Error, Result};

pub(super) const ARCHITECTURE_KEY: &str = "zipsplat.architecture";
pub(super) const DEPTH_ARCHITECTURE_KEY: &str = "zipsplat.depth_architecture";
pub(super) const IMAGE_SIZE_KEY: &str = "zipsplat.image_size";
/// Its name in files without a version.
const PICTURE_SIDE_KEY: &str = "zipsplat.picture_side";
const VERSION_KEY: &str = "zipsplat.format_version";
const VERSION: u32 = 1;
const Q8_ENDS: [&str; 2] = [".q8", ".q8_scales"];
const PREFIX: usize = 8;
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

type Statement = (&'static str, serde_json::Result<String>);

pub(super) fn save(
    values: &Values,
    stated: impl IntoIterator<Item = Statement>,
    path: &Path,
    dtype: Dtype,
    progress: impl FnMut(f64) -> ControlFlow<()>,
) -> Result<()> {
    let file = Unfinished::begin(path)?;
    let mut out = file.writer()?;
    let header = header(values, stated, dtype).map_err(|reason| Error::format(path, None, reason))?;
    write(values, &header, dtype, path, &mut out, progress)?;
    out.flush().and_then(|()| out.get_ref().sync_all()).map_err(|error| Error::io(path, error))?;
    drop(out);
    file.finish()
}

fn write(
    values: &Values,
    header: &str,
    dtype: Dtype,
    path: &Path,
    out: &mut impl Write,
    mut progress: impl FnMut(f64) -> ControlFlow<()>,
) -> Result<()> {
    let file_error = |error: io::Error| Error::io(path, error);
    out.write_all(&(header.len() as u64).to_le_bytes()).map_err(file_error)?;
    out.write_all(header.as_bytes()).map_err(file_error)?;
    let parameters = values.parameters();
    for (i, (name, shape)) in parameters.iter().enumerate() {
        if progress(i as f64 / parameters.len() as f64).is_break() {
            return Err(Error::Cancelled);
        }
        let dtype = dtype.of(name, shape);
        let bytes = match dtype {
            Dtype::Q8 => q8_bytes(&values.read_q8(name)?),
            _ => {
                let mut read = vec![0.0; shape.iter().product()];
                values.read_f32(name, &mut read)?;
                encode(name, &read, dtype)?
            }
        };
        out.write_all(&bytes).map_err(file_error)?;
    }
    Ok(())
}

fn header(values: &Values, stated: impl IntoIterator<Item = Statement>, dtype: Dtype) -> Result<String, String> {
    let mut end = 0;
    let mut tensors = Vec::new();
    for (name, shape) in values.parameters() {
        let mut add = |end_of_name: &str, dtype: FileDtype, size: usize, shape: Vec<usize>| {
            let start = end;
            end += shape.iter().product::<usize>() * size;
            tensors.push((format!("{name}{end_of_name}"), TensorInfo { dtype, shape, data_offsets: (start, end) }));
        };
        match dtype.of(name, shape) {
            Dtype::F32 => add("", FileDtype::F32, 4, shape.clone()),
            Dtype::F16 => add("", FileDtype::F16, 2, shape.clone()),
            Dtype::Bf16 => add("", FileDtype::BF16, 2, shape.clone()),
            Dtype::Q8 => {
                add(Q8_ENDS[0], FileDtype::I8, 1, shape.clone());
                add(Q8_ENDS[1], FileDtype::F16, 2, vec![shape[0], Q8::scales_of(shape[1])]);
            }
        }
    }
    let stated = stated.into_iter().chain([(VERSION_KEY, Ok(VERSION.to_string()))]);
    let metadata = stated.map(|(key, value)| Ok((key.to_string(), value?))).collect::<serde_json::Result<_>>();
    let metadata = metadata.map_err(|error| error.to_string())?;
    let header = Metadata::new(Some(metadata), tensors).map_err(|error| error.to_string())?;
    // Sorted keys, for reproducible files.
    let json = serde_json::to_value(&header).map_err(|error| error.to_string())?.to_string();
    // `format!` widths end at 65,535, below some header lengths.
    let padding = json.len().next_multiple_of(PREFIX) - json.len();
    Ok(json + &" ".repeat(padding))
}

fn q8_bytes(values: &Q8) -> Vec<u8> {
    let scales = values.scales.iter().flat_map(|scale| scale.to_le_bytes());
    bytemuck::cast_slice(&values.integers).iter().copied().chain(scales).collect()
}

fn encode(name: &str, values: &[f32], dtype: Dtype) -> Result<Vec<u8>> {
    let fits = |value: f32| match dtype {
        Dtype::F16 => f16::from_f32(value).is_finite(),
        Dtype::Bf16 => bf16::from_f32(value).is_finite(),
        Dtype::F32 | Dtype::Q8 => true,
    };
    if let Some(value) = values.iter().find(|&&value| !fits(value)) {
        return Err(too_small(dtype, name, *value));
    }
    Ok(match dtype {
        Dtype::F16 => values.iter().flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect(),
        Dtype::Bf16 => values.iter().flat_map(|&value| bf16::from_f32(value).to_le_bytes()).collect(),
        Dtype::F32 | Dtype::Q8 => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
    })
}

pub(super) fn too_small(dtype: Dtype, name: &str, value: f32) -> Error {
    let found = format!("{}, too small for {value} in {name}", dtype.name());
    Error::argument("dtype", found, "a type that holds every value")
}

#[cfg(test)]
mod tests {
    use super::super::Checkpoint;
    use super::*;

    #[test]
    fn headers_of_every_network_and_type_are_whole() {
        for (variant, least) in [("vits", 0), ("vitb", 0), ("vitl", 1 << 16), ("vitg", 1 << 16)] {
            let checkpoint = Checkpoint::seeded(variant, None).expect("a named network");
            for (dtype, bytes) in [(Dtype::F32, 4.0), (Dtype::F16, 2.0), (Dtype::Bf16, 2.0), (Dtype::Q8, 1.0625)] {
                let header = header(&checkpoint, [], dtype).expect("a header");
                assert!(header.len() > least && header.len().is_multiple_of(PREFIX), "{variant}: {}", header.len());
                let parsed: Metadata = serde_json::from_str(&header).expect("the format's own parser takes it");
                let values = checkpoint.architecture().parameter_count();
                let expected = values as f64 * bytes;
                let most = if dtype == Dtype::Q8 { 1.05 * expected } else { expected };
                assert!((expected..=most).contains(&(parsed.data_len() as f64)), "{variant}: {}", parsed.data_len());
                assert!(parsed.tensors().len() >= checkpoint.parameters().len(), "{variant}");
            }
        }
    }
}
