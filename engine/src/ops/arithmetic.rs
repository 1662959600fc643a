use super::tile::Tiles;
use crate::gpu::{Element, Limits, MatrixShape};

/// Precision of matrix products. All other computation is f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// f32 throughout.
    Fp32,
    /// f16 factors.
    Fp16,
    /// bf16 factors, for activations beyond f16's range.
    Bf16,
    /// `Fp16`, with 8-bit integers in blocks' linear layers.
    Int8,
}

impl Precision {
    /// Every precision, slowest first.
    pub const ALL: [Self; 4] = [Self::Fp32, Self::Bf16, Self::Fp16, Self::Int8];

    pub fn best(limits: &Limits) -> Self {
        if !limits.cpu && limits.matrices.f16.is_some() { Precision::Fp16 } else { Precision::Fp32 }
    }

    pub fn name(self) -> &'static str {
        match self {
            Precision::Fp32 => "fp32",
            Precision::Fp16 => "fp16",
            Precision::Bf16 => "bf16",
            Precision::Int8 => "int8",
        }
    }
}

/// Number types and kernels of a precision.
///
/// 16-bit types hold weights and activations that only feed matrix products, saturating. Attention
/// scores stay f32: without q/k norm they exceed 1e4.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arithmetic {
    /// Factor type of matrix products.
    pub element: Element,
    /// For linear layers on lanes.
    pub tiles: Tiles,
    /// For linear layers that are always f32.
    pub exact_tiles: Tiles,
    pub linear: Option<Units>,
    pub attention: Option<Units>,
    /// For blocks' linear layers.
    pub quantized: Option<Units>,
    /// For blocks' 8-bit layers on lanes.
    pub dots: Option<Tiles>,
    /// For k-means, f16 in every precision.
    pub nearest: Option<Units>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Units {
    pub factor: Element,
    pub shape: MatrixShape,
    pub tiles: Tiles,
}

impl Units {
    pub fn of(factor: Element, limits: &Limits) -> Option<Self> {
        limits.matrices.of(factor).map(|shape| Self { factor, shape, tiles: Tiles::default() })
    }
}

impl Arithmetic {
    /// f32 throughout.
    pub const EXACT: Self = Self {
        element: Element::F32,
        tiles: Tiles::BY_RULE,
        exact_tiles: Tiles::BY_RULE,
        linear: None,
        attention: None,
        quantized: None,
        dots: None,
        nearest: None,
    };

    pub(super) fn exact(&self) -> Self {
        Self { tiles: self.exact_tiles, exact_tiles: self.exact_tiles, ..Self::EXACT }
    }

    pub fn has_integers(&self) -> bool {
        self.quantized.is_some() || self.dots.is_some()
    }

    pub fn without_integers(&self) -> Self {
        Self { quantized: None, dots: None, ..*self }
    }

    pub fn of(precision: Precision, limits: &Limits) -> Option<Self> {
        let element = match precision {
            Precision::Fp32 => return Some(Self::EXACT),
            Precision::Fp16 | Precision::Int8 => Element::F16,
            Precision::Bf16 => Element::Bf16,
        };
        let matrices = Units::of(element, limits);
        let int8 = precision == Precision::Int8;
        let quantized = Units::of(Element::I8, limits).filter(|_| int8);
        let dots = (int8 && limits.dot_products).then_some(Tiles::BY_RULE);
        let nearest = Units::of(Element::F16, limits);
        // Attention converts f16 weights through f16 sums.
        let attention = matrices.filter(|_| element != Element::F16 || limits.matrices.f16_sums);
        let all = Self { element, linear: matrices, attention, quantized, dots, nearest, ..Self::EXACT };
        (limits.half_storage && all.has_integers() == int8).then_some(all)
    }
}
