//! Which number types and kernels linear layers and attention use.

use crate::gpu::{Element, Limits, MatrixShape};

/// What is traded for time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// f32 throughout.
    Exact,
    /// Factors of matrix products in f16; sums, softmax, norms and the residual stream in f32.
    Fast,
}

/// Number types and kernels of linear layers and attention.
///
/// With f16, these are rounded to it: weights, and activations that only feed matrix products: normed rows, queries, keys
/// and values, hidden layers, what attention gives. They saturate at 65504 rather than overflow; networks with activations
/// beyond that are not known. Queries are scaled before they are rounded, and scores are f32, so that those of blocks
/// without q/k norm, which reach 1e4 and more, stay finite.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arithmetic {
    /// Type of the factors of matrix products.
    pub element: Element,
    /// Matrix units that linear layers run on, where they do.
    pub linear: Option<MatrixShape>,
    /// Matrix units that attention runs on, where it does.
    pub attention: Option<MatrixShape>,
}

impl Arithmetic {
    /// f32 throughout.
    pub const EXACT: Self = Self { element: Element::F32, linear: None, attention: None };

    /// f16 factors, on matrix units where the device has them; `None` where it cannot hold f16.
    pub fn fast(limits: &Limits) -> Option<Self> {
        let matrices = limits.matrices;
        limits.half_storage.then_some(Self { element: Element::F16, linear: matrices, attention: matrices })
    }
}

impl Precision {
    /// `exact` or `fast`.
    pub fn name(self) -> &'static str {
        match self {
            Precision::Exact => "exact",
            Precision::Fast => "fast",
        }
    }
}
