use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};

use base64::{Engine, engine::general_purpose::STANDARD};

use super::{Document, Parsed, document::Buffer};
use crate::file::read_file;
use crate::scalar::Scalar;
use crate::{Error, Result};

pub(super) struct Buffers<'a> {
    contents: Vec<Cow<'a, [u8]>>,
    of_buffer: Vec<usize>,
}

impl<'a> Buffers<'a> {
    pub(super) fn len(&self) -> usize {
        self.contents.iter().map(|bytes| bytes.len()).sum()
    }

    /// `binary` is the container's chunk, used by the buffer without a URI. Files must be in
    /// `folder` or below; errors name `path`.
    pub(super) fn open(
        buffers: &[Buffer],
        binary: Option<&'a [u8]>,
        path: &Path,
        folder: Option<&Path>,
    ) -> Result<Self> {
        let fail = |i: usize, reason: String| Error::format(path, None, format!("buffer {i}: {reason}"));
        let (mut contents, mut of_buffer) = (Vec::new(), Vec::new());
        let mut files = HashMap::new();
        for (i, buffer) in buffers.iter().enumerate() {
            let mut add = |bytes| {
                contents.push(bytes);
                contents.len() - 1
            };
            let content = match (&buffer.uri, binary) {
                (None, Some(binary)) if i == 0 => add(Cow::Borrowed(binary)),
                (None, _) => return Err(fail(i, "no address and no binary chunk".into())),
                (Some(uri), _) if uri.starts_with("data:") => add(Cow::Owned(embedded(uri).map_err(|e| fail(i, e))?)),
                (Some(uri), _) => {
                    let name = beside(uri).ok_or_else(|| {
                        fail(i, format!("found the address {uri:?}, expected a file in the folder or base64 data"))
                    })?;
                    let memory = || {
                        fail(i, format!("found the file {uri:?}, expected a .glb or base64 data where it is in memory"))
                    };
                    let file = folder.ok_or_else(memory)?.join(name);
                    match files.get(&file) {
                        Some(content) => *content,
                        None => {
                            let bytes = read_file(&file)?;
                            *files.entry(file).or_insert(add(Cow::Owned(bytes)))
                        }
                    }
                }
            };
            let found = contents[content].len();
            if found < buffer.byte_length {
                return Err(fail(i, format!("truncated: found {found} bytes, expected {}", buffer.byte_length)));
            }
            of_buffer.push(content);
        }
        Ok(Self { contents, of_buffer })
    }

    fn get(&self, buffer: usize) -> Option<&[u8]> {
        self.of_buffer.get(buffer).map(|content| &*self.contents[*content])
    }

    /// Checks lengths before allocating.
    pub(super) fn values<const N: usize>(&self, document: &Document, index: usize) -> Parsed<Vec<[f32; N]>> {
        let fail = |reason: String| format!("accessor {index}: {reason}");
        let accessor = document.accessors.get(index).ok_or_else(|| fail("there is none".into()))?;
        let shape = ["SCALAR", "VEC2", "VEC3", "VEC4"][N - 1];
        if accessor.shape != shape || accessor.sparse.is_some() {
            let sparse = if accessor.sparse.is_some() { "sparse " } else { "" };
            return Err(fail(format!("found {sparse}{}, expected {shape}, not sparse", accessor.shape)).into());
        }
        let scalar = component(accessor.component_type).ok_or_else(|| {
            fail(format!("found component type {}, expected 5120 to 5123 or 5126", accessor.component_type))
        })?;
        let view = accessor.buffer_view.and_then(|view| document.buffer_views.get(view));
        let view = view.ok_or_else(|| fail("no such buffer view".into()))?;
        let size = N * scalar.size();
        let stride = view.byte_stride.unwrap_or(size);
        let bytes = self.get(view.buffer).and_then(|bytes| bytes.get(view.byte_offset..)?.get(..view.byte_length));
        let bytes = bytes.and_then(|bytes| bytes.get(accessor.byte_offset..)).unwrap_or_default();
        let needed = accessor.count.checked_sub(1).map_or(Some(0), |last| last.checked_mul(stride)?.checked_add(size));
        if stride < size || needed.is_none_or(|needed| needed > bytes.len()) {
            let found = format!("{} values of {size} bytes every {stride}", accessor.count);
            return Err(fail(format!("found {found}, expected what fits the {} bytes of its view", bytes.len())).into());
        }
        let value = |i: usize| {
            let value = &bytes[i * stride..][..size];
            std::array::from_fn(|c| {
                let number = scalar.read(&value[c * scalar.size()..]);
                if accessor.normalized { normalized(scalar, number) } else { number }
            })
        };
        Ok((0..accessor.count).map(value).collect())
    }
}

fn embedded(uri: &str) -> std::result::Result<Vec<u8>, String> {
    let (_, data) = uri.split_once(";base64,").ok_or("found a data address without base64")?;
    STANDARD.decode(data).map_err(|error| format!("base64: {error}"))
}

fn beside(uri: &str) -> Option<PathBuf> {
    let mut bytes = Vec::new();
    let mut rest = uri.as_bytes();
    while let [first, after @ ..] = rest {
        let (byte, after) = match (first, after) {
            (b'%', [a, b, after @ ..]) => (u8::from_str_radix(std::str::from_utf8(&[*a, *b]).ok()?, 16).ok()?, after),
            _ => (*first, after),
        };
        bytes.push(byte);
        rest = after;
    }
    let path = PathBuf::from(String::from_utf8(bytes).ok()?);
    let inside = |part: Component<'_>| matches!(part, Component::Normal(_) | Component::CurDir);
    (!uri.contains(':') && path.components().all(inside) && path.file_name().is_some()).then_some(path)
}

fn component(code: u32) -> Option<Scalar> {
    Some(match code {
        5120 => Scalar::I8,
        5121 => Scalar::U8,
        5122 => Scalar::I16,
        5123 => Scalar::U16,
        5126 => Scalar::F32,
        _ => return None,
    })
}

fn normalized(scalar: Scalar, value: f32) -> f32 {
    let largest = match scalar {
        Scalar::I8 => f32::from(i8::MAX),
        Scalar::U8 => f32::from(u8::MAX),
        Scalar::I16 => f32::from(i16::MAX),
        Scalar::U16 => f32::from(u16::MAX),
        _ => return value,
    };
    (value / largest).max(-1.0)
}
