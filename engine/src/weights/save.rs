use super::{
    Dtype,
    safetensors::{PREFIX, Q8_ENDS, VERSION, VERSION_KEY, too_small},
    values::Values,
};
use crate::{Error, Result, ops::Q8, types::Unfinished};
use half::{bf16, f16};
use safetensors::{
    Dtype as FileDtype,
    tensor::{Metadata, TensorInfo},
};
use std::{
    io::{self, Write},
    ops::ControlFlow,
    path::Path,
};

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
