//! Number types and kernels of linear layers, attention and k-means use.

use super::tile::Tiles;
use crate::gpu::{Element, Limits, MatrixShape};

/// The precision of matrix products. Sums, softmax, norms, the residual stream and geometry are f32 in all of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// f32 throughout.
    Exact,
    /// Factors of matrix products in f16.
    Fast,
    /// Factors of matrix products in bf16: f32's range in 8 bits, for networks whose activations f16 cannot hold.
    FastBf16,
    /// As `Fast`, and in the linear layers of blocks 8-bit integers: a scale for every token and for every output.
    Turbo,
}

impl Precision {
    /// All, the slowest first.
    pub const ALL: [Self; 4] = [Self::Exact, Self::FastBf16, Self::Fast, Self::Turbo];

    /// The precision where nothing is asked for: fast on GPUs with matrix units, exact on others and on CPUs,
    /// which convert f16 slowly.
    pub fn best(limits: &Limits) -> Self {
        if !limits.cpu && limits.matrices.f16.is_some() { Precision::Fast } else { Precision::Exact }
    }

    /// As on the command line.
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
/// With a type of 16 bits, these are rounded to it: weights, and activations that only feed matrix products: normed rows,
/// queries, keys and values, hidden layers, what attention gives; and the normed rows of an output layer, whose mean goes on
/// beside their product. They saturate at its largest value rather than overflow; networks with activations beyond f16's 65504
/// are not known. Scores are f32, so that those of blocks without q/k norm, which reach 1e4 and more, stay finite.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arithmetic {
    /// Type of the factors of matrix products.
    pub element: Element,
    /// How work is cut for linear layers with such factors on lanes.
    pub tiles: Tiles,
    /// How work is cut for linear layers on lanes that are f32 whatever the precision.
    pub exact_tiles: Tiles,
    /// Matrix units that linear layers run on, where they do.
    pub linear: Option<Units>,
    /// Matrix units that attention runs on, where it does.
    pub attention: Option<Units>,
    /// Matrix units for 8-bit integers that linear layers of blocks run on, where they do.
    pub quantised: Option<Units>,
    /// How work is cut for linear layers of blocks with 8-bit integers on lanes, where they are to run there.
    pub dots: Option<Tiles>,
    /// Matrix units for f16 that k-means finds nearest rows on, where it does: exactly enough in every precision.
    pub nearest: Option<Units>,
}

/// Matrix units as a kernel uses them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Units {
    /// Type of their factors.
    pub factor: Element,
    /// Their shape.
    pub shape: MatrixShape,
    /// How work is cut for them.
    pub tiles: Tiles,
}

impl Units {
    /// The matrix units of a device for factors of a type, with tiles by rule.
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

    /// f32 throughout, with work cut in the same way.
    pub(super) fn exact(&self) -> Self {
        Self { tiles: self.exact_tiles, exact_tiles: self.exact_tiles, ..Self::EXACT }
    }

    /// True where linear layers of blocks have 8-bit integers, on matrix units or without them on lanes.
    pub fn has_integers(&self) -> bool {
        self.quantised.is_some() || self.dots.is_some()
    }

    /// The same without 8-bit integers.
    pub fn without_integers(&self) -> Self {
        Self { quantised: None, dots: None, ..*self }
    }

    /// The arithmetic of a precision, on matrix units where the device has them; `None` where the device cannot compute in it.
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
