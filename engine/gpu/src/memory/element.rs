use half::{bf16, f16};

/// Number type of a kernel variant (`#pragma element`, `#pragma factor`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Element {
    /// IEEE single precision.
    #[default]
    F32,
    /// IEEE half precision: 11 significant bits, at most 65504.
    F16,
    /// Upper half of an f32, with 8 significant bits.
    Bf16,
    /// Factors from -127 to 127 with a separate scale.
    I8,
}

impl Element {
    /// 16-bit types.
    pub const HALVES: [Self; 2] = [Self::F16, Self::Bf16];
    /// Factor types of matrix units.
    pub const FACTORS: [Self; 3] = [Self::F16, Self::Bf16, Self::I8];

    /// Returns the name used in kernel names.
    pub fn name(self) -> &'static str {
        match self {
            Element::F32 => "f32",
            Element::F16 => "f16",
            Element::Bf16 => "bf16",
            Element::I8 => "i8",
        }
    }

    /// Returns the bytes of one value.
    pub fn bytes(self) -> usize {
        match self {
            Element::F32 => 4,
            Element::F16 | Element::Bf16 => 2,
            Element::I8 => 1,
        }
    }

    /// Returns the largest finite value.
    pub fn largest(self) -> f32 {
        match self {
            Element::F32 => f32::MAX,
            Element::F16 => 65504.0,
            Element::Bf16 => f32::from_bits(0x7f7f_0000),
            Element::I8 => 127.0,
        }
    }

    /// Returns the unit roundoff, for integers relative to the largest value.
    pub fn roundoff(self) -> f64 {
        match self {
            Element::F32 => (-24f64).exp2(),
            Element::F16 => (-11f64).exp2(),
            Element::Bf16 => (-8f64).exp2(),
            Element::I8 => 0.5 / 127.0,
        }
    }

    /// Encodes numbers, rounded to nearest and saturated.
    pub fn encode(self, values: &[f32]) -> Vec<u8> {
        let clamped = values.iter().map(|x| x.clamp(-self.largest(), self.largest()));
        match self {
            Element::F32 => bytemuck::cast_slice(values).to_vec(),
            Element::F16 => clamped.flat_map(|x| f16::from_f32(x).to_ne_bytes()).collect(),
            Element::Bf16 => clamped.flat_map(|x| bf16::from_f32(x).to_ne_bytes()).collect(),
            Element::I8 => clamped.map(|x| x.round_ties_even() as i8 as u8).collect(),
        }
    }

    /// Decodes numbers.
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
