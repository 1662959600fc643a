//! Types of numbers in kernels.

use half::{bf16, f16};

/// The type of values that a kernel takes in several types (`#pragma element` and `#pragma factor` in its source).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Element {
    /// IEEE single precision.
    #[default]
    F32,
    /// IEEE half precision: 11 bits, up to 65504.
    F16,
    /// The upper half of a single precision number: 8 bits and its range.
    Bf16,
    /// Whole numbers from -127 to 127, with a scale elsewhere. Only as factors of matrix units.
    I8,
}

impl Element {
    /// Types of 16 bits.
    pub const HALVES: [Self; 2] = [Self::F16, Self::Bf16];
    /// Types of factors that matrix units multiply.
    pub const FACTORS: [Self; 3] = [Self::F16, Self::Bf16, Self::I8];

    /// As in the names of kernels.
    pub fn name(self) -> &'static str {
        match self {
            Element::F32 => "f32",
            Element::F16 => "f16",
            Element::Bf16 => "bf16",
            Element::I8 => "i8",
        }
    }

    /// Bytes of one value.
    pub fn bytes(self) -> usize {
        match self {
            Element::F32 => 4,
            Element::F16 | Element::Bf16 => 2,
            Element::I8 => 1,
        }
    }

    /// The largest value.
    pub fn largest(self) -> f32 {
        match self {
            Element::F32 => f32::MAX,
            Element::F16 => 65504.0,
            Element::Bf16 => f32::from_bits(0x7f7f_0000),
            Element::I8 => 127.0,
        }
    }

    /// The most by which rounding to nearest moves a number, relative to it; of whole numbers, relative to the largest.
    pub fn roundoff(self) -> f64 {
        match self {
            Element::F32 => (-24f64).exp2(),
            Element::F16 => (-11f64).exp2(),
            Element::Bf16 => (-8f64).exp2(),
            Element::I8 => 0.5 / 127.0,
        }
    }

    /// The bytes of numbers in this type, rounded to nearest; what it cannot hold saturates.
    pub fn encode(self, values: &[f32]) -> Vec<u8> {
        let held = values.iter().map(|x| x.clamp(-self.largest(), self.largest()));
        match self {
            Element::F32 => bytemuck::cast_slice(values).to_vec(),
            Element::F16 => held.flat_map(|x| f16::from_f32(x).to_ne_bytes()).collect(),
            Element::Bf16 => held.flat_map(|x| bf16::from_f32(x).to_ne_bytes()).collect(),
            Element::I8 => held.map(|x| x.round_ties_even() as i8 as u8).collect(),
        }
    }

    /// The numbers that bytes of this type hold.
    pub fn decode(self, bytes: &[u8]) -> Vec<f32> {
        let halves = || bytes.as_chunks::<2>().0.iter().copied();
        match self {
            Element::F32 => bytes.as_chunks::<4>().0.iter().copied().map(f32::from_ne_bytes).collect(),
            Element::F16 => halves().map(|x| f16::from_ne_bytes(x).to_f32()).collect(),
            Element::Bf16 => halves().map(|x| bf16::from_ne_bytes(x).to_f32()).collect(),
            Element::I8 => bytes.iter().map(|x| f32::from(*x as i8)).collect(),
        }
    }
}
