//! The safetensors format: a length, a JSON header, then the values.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::Path;

use half::{bf16, f16};
use safetensors::Dtype as FileDtype;
use safetensors::tensor::{Metadata, TensorInfo};

use super::contents::{Contents, MAX_PICTURE_SIDE, add, is_picture_side};
use super::tensor::{Stored, StoredDtype};
use super::{Architecture, Checkpoint, Dtype};
use crate::types::preprocess::PATCH;
use crate::{Error, Result};

/// Key of the metadata that holds the architecture as JSON.
const ARCHITECTURE_KEY: &str = "zipsplat.architecture";
/// Key of the metadata that holds the side of the pictures a network is best with, in pixels.
const PICTURE_SIDE_KEY: &str = "zipsplat.picture_side";
/// Bytes of the header's length.
const PREFIX: usize = 8;
/// The format's own limit.
const MAX_HEADER: u64 = 100_000_000;

/// Finds the tensors of a file; [`Error::Format`] where the header is not true.
pub(super) fn contents(path: &Path, file: &[u8]) -> Result<Contents> {
    let malformed = |reason: String| Error::format(path, None, reason);
    let length = file.first_chunk::<PREFIX>().map(|bytes| u64::from_le_bytes(*bytes));
    let length = length
        .ok_or_else(|| malformed(format!("found {} bytes, neither safetensors nor a zip archive", file.len())))?;
    if length > MAX_HEADER || length > (file.len() - PREFIX) as u64 {
        let size = file.len();
        return Err(malformed(format!("found a safetensors header of {length} bytes in a file of {size} bytes")));
    }
    let start = PREFIX + length as usize;
    let header: Metadata = serde_json::from_slice(&file[PREFIX..start])
        .map_err(|error| malformed(format!("safetensors header: {error}")))?;
    if header.data_len() != file.len() - start {
        let (found, expected) = (file.len() - start, header.data_len());
        return Err(malformed(format!("found {found} bytes of values, the header expects {expected}")));
    }

    let mut found = Contents::default();
    for (name, info) in header.tensors() {
        let dtype = match info.dtype {
            FileDtype::F64 => StoredDtype::F64,
            FileDtype::F32 => StoredDtype::F32,
            FileDtype::F16 => StoredDtype::F16,
            FileDtype::BF16 => StoredDtype::Bf16,
            other => return Err(malformed(format!("{name}: found type {other}, expected F64, F32, F16 or BF16"))),
        };
        let (from, to) = info.data_offsets;
        let tensor = Stored::dense(dtype, info.shape.clone(), start + from, start + to);
        add(&mut found.tensors, &name, tensor).map_err(malformed)?;
    }
    let stated = |key: &str| header.metadata().as_ref().and_then(|metadata| metadata.get(key));
    if let Some(side) = stated(PICTURE_SIDE_KEY) {
        let parsed = side.parse().ok().filter(|side| is_picture_side(*side));
        let expected = format!("a multiple of {PATCH} up to {MAX_PICTURE_SIDE}");
        let side = parsed.ok_or_else(|| malformed(format!("{PICTURE_SIDE_KEY}: found {side}, expected {expected}")))?;
        found.picture_side = Some(side);
    }
    if let Some(json) = stated(ARCHITECTURE_KEY) {
        let architecture: Architecture =
            serde_json::from_str(json).map_err(|error| malformed(format!("{ARCHITECTURE_KEY}: {error}")))?;
        architecture.validate().map_err(|error| malformed(format!("{ARCHITECTURE_KEY}: {error}")))?;
        found.architecture = Some(architecture);
    }
    Ok(found)
}

/// Writes every tensor of `checkpoint` in `dtype`, one at a time. `path` only names `out` in messages.
pub(super) fn write(
    checkpoint: &Checkpoint,
    dtype: Dtype,
    path: &Path,
    out: &mut impl Write,
    mut progress: impl FnMut(f64) -> ControlFlow<()>,
) -> Result<()> {
    let file_error = |error: io::Error| Error::io(path, error);
    let header = header(checkpoint, dtype).map_err(|reason| Error::format(path, None, reason))?;
    out.write_all(&(header.len() as u64).to_le_bytes()).map_err(file_error)?;
    out.write_all(header.as_bytes()).map_err(file_error)?;
    let parameters = checkpoint.parameters();
    for (i, (name, shape)) in parameters.iter().enumerate() {
        if progress(i as f64 / parameters.len() as f64).is_break() {
            return Err(Error::Cancelled);
        }
        let mut values = vec![0.0; shape.iter().product()];
        checkpoint.read_f32(name, &mut values)?;
        out.write_all(&encode(name, &values, dtype)?).map_err(file_error)?;
    }
    Ok(())
}

fn header(checkpoint: &Checkpoint, dtype: Dtype) -> Result<String, String> {
    let file_dtype = match dtype {
        Dtype::F32 => FileDtype::F32,
        Dtype::F16 => FileDtype::F16,
        Dtype::Bf16 => FileDtype::BF16,
    };
    let mut end = 0;
    let tensors = checkpoint.parameters().iter().map(|(name, shape)| {
        let start = end;
        end += shape.iter().product::<usize>() * dtype.size();
        (name.clone(), TensorInfo { dtype: file_dtype, shape: shape.clone(), data_offsets: (start, end) })
    });
    let architecture = serde_json::to_string(checkpoint.architecture()).map_err(|error| error.to_string())?;
    let side = checkpoint.picture_side().to_string();
    let metadata = [(ARCHITECTURE_KEY, architecture), (PICTURE_SIDE_KEY, side)];
    let metadata = metadata.into_iter().map(|(key, value)| (key.to_string(), value)).collect();
    let header = Metadata::new(Some(metadata), tensors.collect()).map_err(|error| error.to_string())?;
    // By way of a value, whose keys are sorted: the same file every time.
    let json = serde_json::to_value(&header).map_err(|error| error.to_string())?.to_string();
    // The format pads with spaces, so that values start at a multiple of 8 bytes. A width of `format!` ends at 65,535,
    // which the headers of the larger networks exceed.
    let padding = json.len().next_multiple_of(PREFIX) - json.len();
    Ok(json + &" ".repeat(padding))
}

/// The bytes of finite values; [`Error::Argument`] where `dtype` cannot hold one of them.
fn encode(name: &str, values: &[f32], dtype: Dtype) -> Result<Vec<u8>> {
    let overflows = |value: f32| match dtype {
        Dtype::F32 => false,
        Dtype::F16 => f16::from_f32(value).is_infinite(),
        Dtype::Bf16 => bf16::from_f32(value).is_infinite(),
    };
    if let Some(value) = values.iter().find(|&&value| overflows(value)) {
        let found = format!("{}, too small for {value} in {name}", dtype.name());
        return Err(Error::argument("dtype", found, "a type that holds every value"));
    }
    Ok(match dtype {
        Dtype::F32 => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
        Dtype::F16 => values.iter().flat_map(|&value| f16::from_f32(value).to_le_bytes()).collect(),
        Dtype::Bf16 => values.iter().flat_map(|&value| bf16::from_f32(value).to_le_bytes()).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The header at its real length; the values of these networks take gigabytes, the header takes none of them.
    #[test]
    fn headers_of_every_network_and_type_are_whole() {
        for (variant, least) in [("vits", 0), ("vitb", 0), ("vitl", 1 << 16), ("vitg", 1 << 16)] {
            let checkpoint = Checkpoint::seeded(variant, None).expect("a named network");
            for dtype in [Dtype::F32, Dtype::F16, Dtype::Bf16] {
                let header = header(&checkpoint, dtype).expect("a header");
                assert!(header.len() > least && header.len().is_multiple_of(PREFIX), "{variant}: {}", header.len());
                let parsed: Metadata = serde_json::from_str(&header).expect("the format's own parser takes it");
                let values = checkpoint.architecture().parameter_count();
                assert_eq!(parsed.data_len(), values * dtype.size(), "{variant}");
                assert_eq!(parsed.tensors().len(), checkpoint.parameters().len(), "{variant}");
            }
        }
    }
}
