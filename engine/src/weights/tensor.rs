use std::str::FromStr;

use half::{bf16, f16};
use rayon::prelude::*;

use crate::{Error, Result, ops::Q8};

/// Storage type, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    F32,
    F16,
    Bf16,
    /// [`Q8`] for linear weights in whole groups; f16 for other matrices, f32 for vectors.
    Q8,
}

impl Dtype {
    const ALL: [Self; 4] = [Self::F32, Self::F16, Self::Bf16, Self::Q8];

    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
            Self::Q8 => "q8",
        }
    }

    pub(super) fn of(self, name: &str, shape: &[usize]) -> Self {
        match (self, shape) {
            (Self::Q8, [_, inner]) if name.ends_with(".weight") && Q8::fits(*inner) => Self::Q8,
            (Self::Q8, [] | [_]) => Self::F32,
            (Self::Q8, _) => Self::F16,
            (dtype, _) => dtype,
        }
    }
}

impl FromStr for Dtype {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let found = Self::ALL.into_iter().find(|dtype| dtype.name() == text);
        found.ok_or_else(|| Error::argument("dtype", text, "f32, f16, bf16 or q8"))
    }
}

pub(super) const MAX_RANK: usize = 8;

/// Readable types; f64 is rounded to f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StoredDtype {
    F64,
    F32,
    F16,
    Bf16,
    I8,
}

impl StoredDtype {
    pub fn size(self) -> usize {
        match self {
            Self::F64 => 8,
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
            Self::I8 => 1,
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::F64 => "f64",
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
            Self::I8 => "i8",
        }
    }
}

/// Element `[i, j, ..]` starts at byte `offset + size * (i * strides[0] + j * strides[1] + ..)`.
#[derive(Debug)]
pub(super) struct Stored {
    pub dtype: StoredDtype,
    pub shape: Vec<usize>,
    strides: Vec<usize>,
    offset: usize,
    scales: Option<usize>,
}

impl Stored {
    /// Fails unless all elements lie before `end`. `strides` may overlap or leave gaps.
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
            Ok(Self { dtype, shape, strides, offset, scales: None })
        } else {
            Err(format!("shape {shape:?} with strides {strides:?} does not lie within its data"))
        }
    }

    pub fn dense(dtype: StoredDtype, shape: Vec<usize>, offset: usize, end: usize) -> Result<Self, String> {
        let strides = c_order(&shape);
        Self::new(dtype, shape, strides, offset, end)
    }

    pub fn with_scales(self, scales: &Self) -> Result<Self, String> {
        let expected = match self.shape[..] {
            [rows, width] if Q8::fits(width) => [rows, width / Q8::GROUP],
            _ => {
                return Err(format!("found integers {:?}, expected rows of whole groups of {}", self.shape, Q8::GROUP));
            }
        };
        if scales.dtype != StoredDtype::F16 || scales.shape != expected {
            let (found, of) = (&scales.shape, scales.dtype.name());
            return Err(format!("found scales {found:?} of {of}, expected {expected:?} of f16"));
        }
        Ok(Self { scales: Some(scales.offset), ..self })
    }

    pub fn is_q8(&self) -> bool {
        self.scales.is_some()
    }

    pub fn bytes(&self) -> usize {
        let values = self.shape.iter().product::<usize>();
        values * self.dtype.size() + self.scales.map_or(0, |_| Q8::scales_of(values) * size_of::<f16>())
    }

    pub fn read_q8(&self, file: &[u8]) -> Q8 {
        let (Some(at), values) = (self.scales, self.shape.iter().product::<usize>()) else { panic!("no integers") };
        let scales = file[at..][..Q8::scales_of(values) * size_of::<f16>()].as_chunks().0;
        Q8 {
            integers: bytemuck::cast_slice(&file[self.offset..][..values]).to_vec(),
            scales: scales.iter().map(|bytes| f16::from_le_bytes(*bytes)).collect(),
        }
    }

    pub fn read(&self, file: &[u8], out: &mut [f32]) {
        let bytes = &file[self.offset..];
        match self.dtype {
            StoredDtype::I8 => self.read_q8(file).values(out),
            // The caller rejects infinity.
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

    fn element(&self, mut rest: usize) -> usize {
        let axes = self.shape.iter().zip(&self.strides).rev();
        axes.fold(0, |sum, (&size, &stride)| {
            let coordinate = rest % size;
            rest /= size;
            sum + coordinate * stride
        })
    }
}

fn c_order(shape: &[usize]) -> Vec<usize> {
    let mut strides = vec![1usize; shape.len()];
    for axis in (1..shape.len()).rev() {
        strides[axis - 1] = strides[axis].saturating_mul(shape[axis]);
    }
    strides
}
