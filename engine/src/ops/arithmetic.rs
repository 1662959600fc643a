//! Precisions, and the number types and kernels that each one selects.

use super::tile::Tiles;
use crate::gpu::{Element, Limits, MatrixShape};

/// Precision of matrix products. Sums, softmax, norms, the residual stream and geometry are always
/// f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// f32 throughout.
    Exact,
    /// f16 factors in matrix products.
    Fast,
    /// bf16 factors in matrix products, for activations beyond f16's range.
    FastBf16,
    /// `Fast`, with 8-bit integers in blocks' linear layers: one scale per token and per output.
    Turbo,
}

impl Precision {
    /// Every precision, slowest first.
    pub const ALL: [Self; 4] = [Self::Exact, Self::FastBf16, Self::Fast, Self::Turbo];

    /// The default: `Fast` on GPUs with matrix units, `Exact` elsewhere. CPUs convert f16 slowly.
    pub fn best(limits: &Limits) -> Self {
        if !limits.cpu && limits.matrices.f16.is_some() { Precision::Fast } else { Precision::Exact }
    }

    /// Name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Precision::Exact => "exact",
            Precision::Fast => "fast",
            Precision::FastBf16 => "fast-bf16",
            Precision::Turbo => "turbo",
        }
    }
}

/// Number types and kernels of linear layers, attention and k-means.
///
/// 16-bit types hold weights and activations that only feed matrix products. Values saturate
/// instead of overflowing. Attention scores stay f32: without q/k norm they reach 1e4 and more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arithmetic {
    /// Type of the factors of matrix products.
    pub element: Element,
    /// Tiles of linear layers on lanes, with factors of type `element`.
    pub tiles: Tiles,
    /// Tiles of linear layers on lanes that are f32 in every precision.
    pub exact_tiles: Tiles,
    /// Matrix units for linear layers.
    pub linear: Option<Units>,
    /// Matrix units for attention.
    pub attention: Option<Units>,
    /// 8-bit matrix units for blocks' linear layers.
    pub quantised: Option<Units>,
    /// Tiles of blocks' 8-bit linear layers on lanes.
    pub dots: Option<Tiles>,
    /// f16 matrix units for k-means, exact enough in every precision.
    pub nearest: Option<Units>,
}

/// A device's matrix units, as configured for a kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Units {
    /// Type of the factors.
    pub factor: Element,
    /// Shape of one matrix product.
    pub shape: MatrixShape,
    /// Tiles by size of the result.
    pub tiles: Tiles,
}

impl Units {
    /// Returns the device's matrix units for a factor type, with default tiles.
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
        quantised: None,
        dots: None,
        nearest: None,
    };

    /// Returns the f32 arithmetic, with tuned tiles.
    pub(super) fn exact(&self) -> Self {
        Self { tiles: self.exact_tiles, exact_tiles: self.exact_tiles, ..Self::EXACT }
    }

    /// Whether blocks' linear layers use 8-bit integers.
    pub fn has_integers(&self) -> bool {
        self.quantised.is_some() || self.dots.is_some()
    }

    /// Returns the arithmetic without 8-bit integers.
    pub fn without_integers(&self) -> Self {
        Self { quantised: None, dots: None, ..*self }
    }

    /// Returns the arithmetic of a precision, or `None` if the device does not support it.
    pub fn of(precision: Precision, limits: &Limits) -> Option<Self> {
        let element = match precision {
            Precision::Exact => return Some(Self::EXACT),
            Precision::Fast | Precision::Turbo => Element::F16,
            Precision::FastBf16 => Element::Bf16,
        };
        let matrices = Units::of(element, limits);
        let turbo = precision == Precision::Turbo;
        let quantised = Units::of(Element::I8, limits).filter(|_| turbo);
        let dots = (turbo && limits.dot_products).then_some(Tiles::BY_RULE);
        let nearest = Units::of(Element::F16, limits);
        let all = Self { element, linear: matrices, attention: matrices, quantised, dots, nearest, ..Self::EXACT };
        (limits.half_storage && all.has_integers() == turbo).then_some(all)
    }
}
