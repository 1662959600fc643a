#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Reads the number at the start of `bytes`.
    pub fn read(self, bytes: &[u8]) -> f32 {
        match self {
            Self::I8 => f32::from(i8::from_le_bytes(first(bytes))),
            Self::U8 => f32::from(u8::from_le_bytes(first(bytes))),
            Self::I16 => f32::from(i16::from_le_bytes(first(bytes))),
            Self::U16 => f32::from(u16::from_le_bytes(first(bytes))),
            Self::I32 => i32::from_le_bytes(first(bytes)) as f32,
            Self::U32 => u32::from_le_bytes(first(bytes)) as f32,
            Self::F32 => f32::from_le_bytes(first(bytes)),
            Self::F64 => f64::from_le_bytes(first(bytes)) as f32,
        }
    }
}

pub(crate) fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
    *bytes.first_chunk().expect("numbers lie within the bytes")
}
