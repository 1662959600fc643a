//! A tensor inside a mapped file, and the number types it may have.

use std::str::FromStr;

use half::{bf16, f16};
use rayon::prelude::*;

use crate::{Error, Result};

/// How a checkpoint stores its values, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// IEEE single precision.
    F32,
    /// IEEE half precision.
    F16,
    /// The upper half of a single.
    Bf16,
}

impl Dtype {
    /// Bytes of one value.
    pub fn size(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    /// `f32`, `f16` or `bf16`.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
        }
    }
}

impl FromStr for Dtype {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        [Self::F32, Self::F16, Self::Bf16]
            .into_iter()
            .find(|dtype| dtype.name() == text)
            .ok_or_else(|| Error::argument("dtype", text, "f32, f16 or bf16"))
    }
}

/// Axes of a tensor at most: files may have more, weights have four.
pub(super) const MAX_RANK: usize = 8;

/// The types of numbers that are read: those of [`Dtype`], and f64, which is rounded to f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StoredDtype {
    F64,
    F32,
    F16,
    Bf16,
}

impl StoredDtype {
    /// Bytes of one value.
    pub fn size(self) -> usize {
        match self {
            Self::F64 => 8,
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    /// `f64`, `f32`, `f16` or `bf16`.
    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
        }
    }
}

/// Where a tensor lies: element `[i, j, ..]` starts at byte `offset + size * (i * strides[0] + j * strides[1] + ..)`.
#[derive(Debug)]
pub(super) struct Stored {
    pub dtype: StoredDtype,
    pub shape: Vec<usize>,
    strides: Vec<usize>,
    offset: usize,
}

impl Stored {
    /// A tensor whose elements all lie within the first `end` bytes; the reason, where they do not.
    ///
    /// `strides` count elements and may overlap or leave gaps.
    pub fn new(
        dtype: StoredDtype,
        shape: Vec<usize>,
        strides: Vec<usize>,
        offset: usize,
        end: usize,
    ) -> Result<Self, String> {
        if shape.len().max(strides.len()) > MAX_RANK {
            return Err(format!("found {} axes, expected at most {MAX_RANK}", shape.len()));
        }
        let past_last = || {
            shape.iter().try_fold(1usize, |count, &size| count.checked_mul(size))?;
            let steps = shape
                .iter()
                .zip(&strides)
                .try_fold(0usize, |sum, (&size, &stride)| sum.checked_add(size.checked_sub(1)?.checked_mul(stride)?))?;
            steps.checked_add(1)?.checked_mul(dtype.size())?.checked_add(offset)
        };
        if shape.len() == strides.len() && past_last().is_some_and(|byte| byte <= end) {
            Ok(Self { dtype, shape, strides, offset })
        } else {
            Err(format!("shape {shape:?} with strides {strides:?} does not lie within its data"))
        }
    }

    /// A tensor in C order without gaps.
    pub fn dense(dtype: StoredDtype, shape: Vec<usize>, offset: usize, end: usize) -> Result<Self, String> {
        let strides = c_order(&shape);
        Self::new(dtype, shape, strides, offset, end)
    }

    /// All elements in C order, out of the file that holds them.
    pub fn read(&self, file: &[u8], out: &mut [f32]) {
        let bytes = &file[self.offset..];
        match self.dtype {
            // A value beyond f32 becomes infinite, which the caller refuses.
            StoredDtype::F64 => self.gather(bytes, out, |bytes| f64::from_le_bytes(bytes) as f32),
            StoredDtype::F32 => self.gather(bytes, out, f32::from_le_bytes),
            StoredDtype::F16 => self.gather(bytes, out, |bytes| f16::from_le_bytes(bytes).to_f32()),
            StoredDtype::Bf16 => self.gather(bytes, out, |bytes| bf16::from_le_bytes(bytes).to_f32()),
        }
    }

    fn gather<const N: usize>(&self, bytes: &[u8], out: &mut [f32], decode: impl Fn([u8; N]) -> f32 + Sync) {
        let elements = bytes.as_chunks::<N>().0;
        let out = out.par_iter_mut().with_min_len(4096).enumerate();
        if self.strides == c_order(&self.shape) {
            out.for_each(|(i, out)| *out = decode(elements[i]));
        } else {
            out.for_each(|(i, out)| *out = decode(elements[self.element(i)]));
        }
    }

    /// Position in storage of the element that is `rest`-th in C order.
    fn element(&self, mut rest: usize) -> usize {
        let axes = self.shape.iter().zip(&self.strides).rev();
        axes.fold(0, |sum, (&size, &stride)| {
            let coordinate = rest % size;
            rest /= size;
            sum + coordinate * stride
        })
    }
}

/// Strides, in elements, of a tensor without gaps.
fn c_order(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1usize; shape.len()];
    for axis in (1..shape.len()).rev() {
        strides[axis - 1] = strides[axis].saturating_mul(shape[axis]);
    }
    strides
}
