//! Goldens: safetensors dumps of the PyTorch implementation (see `data/README.md`).
//!
//! Without a golden, `find` and `open` print a line and return `None`: the test passes.

use std::collections::BTreeSet;
use std::env;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use safetensors::tensor::{Metadata, TensorInfo};
use safetensors::{Dtype, SafeTensors};
use zipsplat::{gpu::cache_dir, perceptual::Perceptual, stages::lpips::LpipsNetwork};

const LENGTH_BYTES: usize = 8;

/// `ZIPSPLAT_GOLDENS` (gradients, networks), committed, shared.
fn folders() -> Vec<PathBuf> {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    let beside = [tests.join("data"), tests.join("../../shared/golden/data")];
    env::var_os("ZIPSPLAT_GOLDENS").map(PathBuf::from).into_iter().chain(beside).collect()
}

pub fn find(file: &str) -> Option<PathBuf> {
    let found = folders().into_iter().map(|folder| folder.join(file)).find(|path| path.is_file());
    if found.is_none() {
        // The harness swallows `println!`.
        let _ = writeln!(io::stderr(), "golden {file} is absent (tests/data, ../shared/golden/data): not compared");
    }
    found
}

pub fn lpips_weights(network: LpipsNetwork) -> Option<PathBuf> {
    let found = Perceptual::file(network, cache_dir().as_deref());
    if let Err(error) = &found {
        let _ = writeln!(io::stderr(), "{error}: not compared");
    }
    found.ok()
}

pub fn interleaved<T: Copy>(planes: &[T], pixels: usize) -> Vec<T> {
    let picture = |planes: &[T]| (0..3 * pixels).map(|i| planes[i % 3 * pixels + i / 3]).collect::<Vec<_>>();
    planes.chunks(3 * pixels).flat_map(picture).collect()
}

pub fn list(prefix: &str) -> Vec<String> {
    let entries = folders().into_iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten();
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let matching = names.filter(|name| name.starts_with(prefix) && name.ends_with(".safetensors"));
    matching.collect::<BTreeSet<_>>().into_iter().collect()
}

pub fn json(file: &str) -> Option<serde_json::Value> {
    let path = find(file)?;
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    Some(serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display())))
}

pub struct Golden {
    file: String,
    bytes: Vec<u8>,
    data_start: usize,
    header: Metadata,
}

impl Golden {
    pub fn open(file: &str) -> Option<Golden> {
        let path = find(file)?;
        let bytes = fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let (header_len, header) =
            SafeTensors::read_metadata(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        Some(Golden { file: file.to_owned(), bytes, data_start: LENGTH_BYTES + header_len, header })
    }

    pub fn committed(file: &str) -> Golden {
        Golden::open(file).unwrap_or_else(|| panic!("golden {file} must be in tests/data"))
    }

    pub fn file(&self) -> &str {
        &self.file
    }

    pub fn has(&self, key: &str) -> bool {
        self.header.info(key).is_some()
    }

    pub fn keys(&self) -> Vec<String> {
        self.header.tensors().into_keys().collect::<BTreeSet<_>>().into_iter().collect()
    }

    pub fn stems(&self, suffix: &str) -> Vec<String> {
        self.keys().iter().filter_map(|key| key.strip_suffix(suffix)).map(str::to_owned).collect()
    }

    pub fn metadata(&self, name: &str) -> &str {
        let entry = self.header.metadata().as_ref().and_then(|entries| entries.get(name));
        entry.unwrap_or_else(|| panic!("{}: no metadata {name:?}", self.file))
    }

    /// Returns ratios with their key prefixes: `(0.5, "r0.5")`.
    pub fn compressions(&self) -> Vec<(f64, String)> {
        let ratios: Vec<f64> = serde_json::from_str(self.metadata("compressions")).expect("a list of ratios");
        ratios.into_iter().map(|ratio| (ratio, format!("r{ratio}"))).collect()
    }

    pub fn shape(&self, key: &str) -> &[usize] {
        &self.info(key).shape
    }

    pub fn f32(&self, key: &str) -> Vec<f32> {
        self.values(key, Dtype::F32, f32::from_le_bytes)
    }

    /// Widens F32. Keys ending in `@f64` are F64.
    pub fn f64(&self, key: &str) -> Vec<f64> {
        match self.info(key).dtype {
            Dtype::F64 => self.values(key, Dtype::F64, f64::from_le_bytes),
            _ => self.f32(key).into_iter().map(f64::from).collect(),
        }
    }

    /// Widens I32.
    pub fn i64(&self, key: &str) -> Vec<i64> {
        match self.info(key).dtype {
            Dtype::I32 => self.i32(key).into_iter().map(i64::from).collect(),
            _ => self.values(key, Dtype::I64, i64::from_le_bytes),
        }
    }

    pub fn i32(&self, key: &str) -> Vec<i32> {
        self.values(key, Dtype::I32, i32::from_le_bytes)
    }

    /// Takes I64 or I32.
    pub fn u32(&self, key: &str) -> Vec<u32> {
        let index = |value: i64| u32::try_from(value).unwrap_or_else(|_| panic!("{} {key}: {value}", self.file));
        self.i64(key).into_iter().map(index).collect()
    }

    pub fn u8(&self, key: &str) -> Vec<u8> {
        self.values(key, Dtype::U8, |[byte]| byte)
    }

    fn info(&self, key: &str) -> &TensorInfo {
        self.header.info(key).unwrap_or_else(|| panic!("{}: no tensor {key:?}", self.file))
    }

    fn values<T, const N: usize>(&self, key: &str, dtype: Dtype, from_le: fn([u8; N]) -> T) -> Vec<T> {
        let info = self.info(key);
        assert_eq!(info.dtype, dtype, "{}: type of {key:?}", self.file);
        let (start, end) = info.data_offsets;
        let bytes = &self.bytes[self.data_start + start..self.data_start + end];
        bytes.chunks_exact(N).map(|chunk| from_le(chunk.try_into().expect("chunks of N"))).collect()
    }
}
