//! Peak arithmetic and copy throughput, for benchmarks.
//!
//! Reports no work: the recorder must not split dispatches.

use super::Units;
use crate::{
    gpu::{Element, Limits, MatrixShape, Recorder, Tensor},
    kernels::measure as kernels,
};

/// The size is a multiple of 16 bytes.
pub fn copy(rec: &mut Recorder, from: Tensor) -> Tensor {
    let out = rec.tensor::<u8>("copy", from.bytes() as usize);
    let quads = from.bytes() as usize / 16;
    rec.dispatch(kernels::Copy { source: from, out, quads: quads as u32 }, quads);
    out
}

/// FMA chains on every lane.
#[derive(Clone, Copy, Debug)]
pub struct FmaChains {
    pub threads: usize,
    /// Rounds of [`FmaChains::STEPS`] steps.
    pub iterations: u32,
    pub factor: f32,
    pub term: f32,
}

impl FmaChains {
    /// Chains per invocation: hides latency, fits 16 registers.
    pub const CHAINS: u32 = 12;
    pub const STEPS: u32 = 8;

    pub fn flops(&self) -> u64 {
        2 * self.threads as u64 * u64::from(Self::CHAINS * Self::STEPS) * u64::from(self.iterations)
    }

    /// Returns `[threads]` f32 chain sums.
    pub fn record(&self, rec: &mut Recorder) -> Tensor {
        let out = rec.tensor::<f32>("out", self.threads);
        let kernel = kernels::Fma {
            out,
            count: self.threads as u32,
            iterations: self.iterations,
            factor: self.factor,
            term: self.term,
            quads: Self::CHAINS / 4,
            steps: Self::STEPS,
        };
        rec.dispatch(kernel, self.threads);
        out
    }
}

#[derive(Clone, Copy, Debug)]
pub struct MatrixProducts {
    pub units: Units,
    /// Redundant subgroups, a multiple of [`MatrixProducts::SUBGROUPS`].
    pub subgroups: usize,
    /// Accumulations of all products.
    pub iterations: u32,
    /// Bit `i % 32` swaps left factors after iteration `i`.
    pub swaps: u32,
}

impl MatrixProducts {
    /// Subgroups per workgroup.
    pub const SUBGROUPS: usize = 4;

    /// Independent products per iteration, fewer on CPUs to limit compile time.
    pub fn products(limits: &Limits) -> usize {
        if limits.cpu { 4 } else { 8 }
    }

    pub fn flops(&self, limits: &Limits) -> u64 {
        let MatrixShape { m, n, k } = self.units.shape;
        let products = (self.subgroups * Self::products(limits)) as u64 * u64::from(self.iterations);
        2 * products * u64::from(m * n * k)
    }

    /// Returns `[subgroups, m, n]`, the sum of `a[s] b[p]` over iterations and products. `a` is
    /// `[2, m, k]`, alternated by swaps; `b` is `[products, k, n]`.
    pub fn record(&self, rec: &mut Recorder, a: Tensor, b: Tensor) -> Tensor {
        let MatrixShape { m, n, k } = self.units.shape;
        let out = rec.tensor::<u32>("out", self.subgroups * (m * n) as usize);
        let kernel = kernels::Matrix {
            a,
            b,
            out,
            iterations: self.iterations,
            swaps: self.swaps,
            subgroups: Self::SUBGROUPS as u32,
            matrix_m: m,
            matrix_n: n,
            matrix_k: k,
            products: Self::products(rec.limits()) as u32,
            factor: self.units.factor,
        };
        rec.dispatch_groups(kernel, self.subgroups / Self::SUBGROUPS);
        out
    }

    pub fn sums(&self, words: Vec<u32>) -> Vec<f32> {
        let number = |word: u32| match self.units.factor {
            Element::I8 => word as i32 as f32,
            _ => f32::from_bits(word),
        };
        words.into_iter().map(number).collect()
    }
}
