use super::{Held, Problem, Truth};
use crate::{Mode, bound::half};
use rayon::prelude::*;
use std::f64::consts::PI;
use zipsplat::{gpu::Element, kernels::limits::GROUP_FOLD};
use zipsplat_reference::ops::activation::{gelu, sigmoid};

#[derive(Clone, Copy, Debug)]
pub enum Fault {
    HalfSum,
    HalfFactors,
    CutIntegers,
    /// Negative 8-bit weights read as 256 more.
    Unsigned,
    LastTerm,
    /// Drops terms from this index on.
    TermsFrom(usize),
    /// Drops one term; every term is tried.
    AnyTerm,
    NeighborColumn,
    NeighborRow,
    /// The last row or column repeats the one before.
    LastRow,
    LastColumn,
    Folded,
    PastEnd,
    NoBias,
    NoActivation,
    TanhGelu,
    /// SiLU as e^x / (1 + e^x) in f32.
    OverflowingExp,
    SwappedGate,
    HalfResult,
    NoScale,
    NoResidual,
    ScaledResidual,
    NoSign,
    /// Scale of the next weight group, cyclically.
    NextScale,
    /// Weights reversed within groups of four terms.
    TurnedTerms,
}

impl Problem {
    pub(super) fn wrong(&self, truth: &Truth, fault: Fault, mode: Mode) -> Vec<Vec<f64>> {
        let (columns, wide) = (self.columns, self.out_columns());
        let result = |place: &dyn Fn(usize, usize) -> usize| -> Vec<Vec<f64>> {
            vec![(0..self.rows * wide).map(|i| truth.values[place(i / wide, i % wide)]).collect()]
        };
        let all = |held: &Held| self.finish(&self.sums(held, |x| x, |_| true));
        match fault {
            Fault::HalfSum => vec![self.finish(&self.sums(&truth.held, half, |_| true))],
            Fault::HalfFactors if mode == Mode::EXACT => vec![all(&Held::new(self, Mode::F16, f64::round_ties_even))],
            Fault::CutIntegers if self.factor(mode) == Element::I8 => vec![all(&Held::new(self, mode, f64::trunc))],
            Fault::Unsigned if self.factor(mode) == Element::I8 => {
                let mut held = Held::new(self, mode, f64::round_ties_even);
                for row in held.weight.chunks_mut(self.inner) {
                    let scale = row.iter().fold(0.0, |most: f64, w| most.max(w.abs())) / 127.0;
                    row.iter_mut().filter(|w| **w < 0.0).for_each(|w| *w += 256.0 * scale);
                }
                vec![all(&held)]
            }
            Fault::HalfFactors | Fault::CutIntegers | Fault::Unsigned => Vec::new(),
            Fault::LastTerm => vec![self.finish(&self.sums(&truth.held, |x| x, |k| k + 1 < self.inner))],
            Fault::TermsFrom(end) => vec![self.finish(&self.sums(&truth.held, |x| x, |k| k < end))],
            Fault::AnyTerm => (0..self.inner).map(|k| self.finish(&self.without(truth, k))).collect(),
            Fault::NeighborColumn => result(&|row, column| row * wide + (column + 1) % wide),
            Fault::NeighborRow => result(&|row, column| (row + 1) % self.rows * wide + column),
            Fault::LastRow => result(&|row, column| row.min(self.rows - 2) * wide + column),
            Fault::LastColumn => result(&|row, column| row * wide + column.min(wide - 2)),
            Fault::Folded => result(&|row, column| row % GROUP_FOLD as usize * wide + column),
            Fault::NoBias => {
                let bare = |(i, sum): (usize, &f64)| sum - f64::from(self.bias[i % columns]);
                vec![self.finish(&truth.sums.iter().enumerate().map(bare).collect::<Vec<_>>())]
            }
            Fault::NoSign | Fault::NextScale | Fault::TurnedTerms => {
                let mut held = Held::new(self, mode, f64::round_ties_even);
                held.weight = self.wrongly_expanded(fault);
                vec![all(&held)]
            }
            Fault::HalfResult => vec![truth.values.iter().map(|&x| half(x)).collect()],
            _ => vec![self.wrongly_finished(truth, fault)],
        }
    }

    fn wrongly_finished(&self, truth: &Truth, fault: Fault) -> Vec<f64> {
        let sums = &truth.sums;
        match fault {
            Fault::NoActivation if self.out_columns() < self.columns => self.gated(sums, |gate, value| gate * value),
            Fault::NoActivation => sums.clone(),
            Fault::TanhGelu => {
                let fit = |&z: &f64| 0.5 * z * (1.0 + ((2.0 / PI).sqrt() * (z + 0.044715 * z.powi(3))).tanh());
                sums.iter().map(fit).collect()
            }
            Fault::OverflowingExp => self.gated(sums, |gate, value| {
                let e = (gate as f32).exp();
                gate * f64::from(e / (1.0 + e)) * value
            }),
            Fault::SwappedGate => self.gated(sums, |gate, value| gate * sigmoid(value) * value),
            Fault::NoScale => self.added(sums, |value, _, residual| value + residual),
            Fault::NoResidual => self.added(sums, |value, gamma, _| value * gamma),
            Fault::ScaledResidual => self.added(sums, |value, gamma, residual| (value + residual) * gamma),
            _ => sums.iter().map(|&z| gelu(z)).collect(),
        }
    }

    fn sums(&self, held: &Held, round: fn(f64) -> f64, has: impl Fn(usize) -> bool + Sync) -> Vec<f64> {
        let one = |i: usize| {
            let (row, column) = (i / self.columns, i % self.columns);
            let terms = held.channels[row].iter().filter(|&&k| has(k));
            let products = terms.map(|k| held.x[row * self.inner + k] * held.weight[column * self.inner + k]);
            round(products.fold(0.0, |sum, product| round(sum + product)) + f64::from(self.bias[column]))
        };
        (0..self.rows * self.columns).into_par_iter().map(one).collect()
    }

    fn without(&self, truth: &Truth, k: usize) -> Vec<f64> {
        let held = &truth.held;
        let product =
            |i: usize| held.x[i / self.columns * self.inner + k] * held.weight[i % self.columns * self.inner + k];
        truth.sums.iter().enumerate().map(|(i, sum)| sum - product(i)).collect()
    }
}
