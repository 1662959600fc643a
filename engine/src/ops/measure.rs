//! Arithmetic in registers and nothing else, and copies: what a device can do at most, for benchmarks to compare with.
//!
//! The recorder is not told how much it is, because it must not cut these dispatches: whoever measures gives them a length.

use super::Units;
use crate::{
    gpu::{Element, Limits, MatrixShape, Recorder, Tensor},
    kernels::measure as kernels,
};

/// A copy of `from`, whole multiples of 16 bytes, by a kernel: each byte is read once and written once.
pub fn copy(rec: &mut Recorder, from: Tensor) -> Tensor {
    let out = rec.tensor::<u8>("copy", from.bytes() as usize);
    let quads = from.bytes() as usize / 16;
    rec.dispatch(kernels::Copy { source: from, out, quads: quads as u32 }, quads);
    out
}

/// Chains of steps x = x * factor + term on every lane of a device.
#[derive(Clone, Copy, Debug)]
pub struct FmaChains {
    /// Invocations.
    pub threads: usize,
    /// Rounds of [`FmaChains::STEPS`] steps.
    pub iterations: u32,
    /// The number that a step multiplies by.
    pub factor: f32,
    /// The number that a step adds.
    pub term: f32,
}

impl FmaChains {
    /// Chains of an invocation: twice 4 cycles of latency and more, and few enough for 16 registers.
    pub const CHAINS: u32 = 12;
    /// Steps of a chain in one iteration.
    pub const STEPS: u32 = 8;

    /// Multiplications and additions.
    pub fn flops(&self) -> u64 {
        2 * self.threads as u64 * u64::from(Self::CHAINS * Self::STEPS) * u64::from(self.iterations)
    }

    /// `[threads]` f32: each invocation's chains added up. Chain `c` of invocation `t` starts at `t % 16 + 16 c`.
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

/// Products of matrices on a device's matrix units, added up.
#[derive(Clone, Copy, Debug)]
pub struct MatrixProducts {
    /// Matrix units; their tiles do not matter.
    pub units: Units,
    /// Subgroups, a multiple of [`MatrixProducts::SUBGROUPS`]. Each computes the same.
    pub subgroups: usize,
    /// How often all products are added.
    pub iterations: u32,
    /// Bit `i % 32` exchanges the left factors behind iteration `i`.
    pub swaps: u32,
}

impl MatrixProducts {
    /// Subgroups of a workgroup.
    pub const SUBGROUPS: usize = 4;

    /// Products of an iteration: sums that do not wait for each other. On a CPU matrices are loops that take long to compile.
    pub fn products(limits: &Limits) -> usize {
        if limits.cpu { 4 } else { 8 }
    }

    /// Multiplications and additions.
    pub fn flops(&self, limits: &Limits) -> u64 {
        let MatrixShape { m, n, k } = self.units.shape;
        let products = (self.subgroups * Self::products(limits)) as u64 * u64::from(self.iterations);
        2 * products * u64::from(m * n * k)
    }

    /// `[subgroups, m, n]`, see [`MatrixProducts::sums`]: the sum of `a[s] b[p]` over iterations and products `p`, of `a`
    /// `[2, m, k]`, whose first is the left factor until they are exchanged, and `b` `[products, k, n]`.
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

    /// The numbers that the words of a result stand for: f32, or where factors are 8-bit integers whole numbers.
    pub fn sums(&self, words: Vec<u32>) -> Vec<f32> {
        let number = |word: u32| match self.units.factor {
            Element::I8 => word as i32 as f32,
            _ => f32::from_bits(word),
        };
        words.into_iter().map(number).collect()
    }
}
