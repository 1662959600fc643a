//! `.npy` arrays, f32 `[height][width]` or `[height][width][channels]`, little-endian, row-major.

use std::path::Path;
use zipsplat::{Error, Result};

const MAGIC: &[u8] = b"\x93NUMPY";
const START: &str = "{'descr': '<f4', 'fortran_order': False, 'shape': (";

pub fn encode(shape: &[u32], values: &[f32]) -> Vec<u8> {
    let sides = shape.iter().map(u32::to_string).collect::<Vec<_>>().join(", ");
    let header = format!("{START}{sides}), }}");
    let mut bytes = [MAGIC, b"\x01\x00\x76\x00"].concat();
    bytes.extend(format!("{header:<117}\n").bytes());
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

pub fn read(path: &Path) -> Result<([u32; 2], Vec<f32>)> {
    let ([height, width], values) = read_array(path, "height, width")?;
    Ok(([width, height], values))
}

/// `named` lists the dimensions.
pub fn read_array<const N: usize>(path: &Path, named: &str) -> Result<([u32; N], Vec<f32>)> {
    let bytes = std::fs::read(path).map_err(|error| Error::io(path, error))?;
    let malformed = |found: &str| {
        let reason = format!("found {found}, expected NumPy's .npy of little-endian f32 [{named}], row by row");
        Error::format(path, None, reason)
    };
    let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| malformed("no .npy"))?;
    let (at, length) = match rest {
        [1, _, a, b, ..] => (4, usize::from(u16::from_le_bytes([*a, *b]))),
        [2 | 3, _, a, b, c, d, ..] => (6, u32::from_le_bytes([*a, *b, *c, *d]) as usize),
        _ => return Err(malformed("a version that is not known")),
    };
    let header = rest.get(at..).and_then(|rest| rest.get(..length)).ok_or_else(|| malformed("no whole header"))?;
    let header = String::from_utf8_lossy(header).trim().to_owned();
    let shape = header.strip_prefix(START).and_then(|rest| rest.split(')').next());
    let sides: Option<Vec<u32>> =
        shape.map(|shape| shape.split(',').filter_map(|side| side.trim().parse().ok()).collect());
    let Some(shape) = sides.and_then(|sides| <[u32; N]>::try_from(sides).ok()) else {
        return Err(malformed(&header));
    };
    let (values, []) = rest[at + length..].as_chunks::<4>() else { return Err(malformed("a part of a value")) };
    let values: Vec<f32> = values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    if values.len() as u64 != shape.map(u64::from).iter().product::<u64>() {
        return Err(malformed(&format!(
            "{} values for {}",
            values.len(),
            shape.map(|side| side.to_string()).join(" x ")
        )));
    }
    Ok((shape, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("depth.npy");
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("written");
            read(&path)
        };
        let (values, bytes) = ([0.5, 1.0, -2.0, 3.0, 0.0, 7.5], encode(&[2, 3], &[0.5, 1.0, -2.0, 3.0, 0.0, 7.5]));
        assert_eq!(read(&bytes).expect("a picture"), ([3, 2], values.to_vec()));
        assert!(read(&bytes[..bytes.len() - 4]).is_err_and(|error| error.to_string().contains("5 values for 2 x 3")));
        let wide: Vec<u8> = String::from_utf8_lossy(&bytes[10..128]).replace("<f4", "<f8").into_bytes();
        assert!(read(&[&bytes[..10], &wide, &bytes[128..]].concat()).is_err_and(|e| e.to_string().contains("<f8")));
    }
}
