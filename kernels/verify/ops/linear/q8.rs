use super::{
    Fault::{self, *},
    Problem, Residual, cases,
};
use crate::prelude::*;
use zipsplat::ops::{Activation, Q8};

const REASON: &str = "That of ops/linear, for the weights that the integers and scales stand for: f32 holds each product of the two. \
    On matrix units it becomes a factor, which moves it by 2^-10 as f16, by a conversion that may round either way, and by 2^-8 as bf16";

const SUMS: [Fault; 2] = [NeighborColumn, NeighborRow];

pub fn q8_area() -> Area {
    let mut area = Area::new("ops/linear of q8 weights", "terms of a sum (K)", Mode::Q8, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, make: fn() -> Problem, size: usize| {
        area.add(name, size, catches, make);
    };
    let random = || Catches::from(SUMS).and(&[NoSign, TurnedTerms]);
    add("random", random().and(&[LastTerm, NoBias]), || Problem::random(17, 32, 40), 32);
    add("random", random(), || Problem::random(17, 384, 40), 384);
    add("random", random(), || Problem::random(17, 1536, 40), 1536);
    add("random", SUMS.into(), || Problem::random(17, 8192, 40), 8192);
    add("33 rows, 5 columns", [LastRow, LastColumn, PastEnd].into(), || Problem::random(33, 32, 5), 32);
    add("300 rows, 264 columns", [LastRow, LastColumn, PastEnd].into(), || Problem::random(300, 64, 264), 64);
    add("groups 10,000 times apart", Catches::from(SUMS).and(&[NoSign, NextScale]), apart, 384);
    add("the smallest and largest scales", [NoSign, NextScale].into(), extreme, 64);
    add("one channel at a time", [AnyTerm, NeighborColumn, NoSign, NextScale, TurnedTerms].into(), one_hot, 96);
    let gelu = || Problem { activation: Activation::Gelu, ..Problem::random(21, 384, 64) };
    add("GELU", [NoActivation, NoSign].into(), gelu, 384);
    let swiglu = || Problem { activation: Activation::SwiGlu, ..Problem::random(21, 64, 64) };
    add("SwiGLU", [NoActivation, NoSign, SwappedGate].into(), swiglu, 64);
    let scaled = || Problem { scaled: true, residual: Residual::InPlace, ..Problem::random(37, 384, 56) };
    add("layer scale and residual in place", [NoScale, NoResidual, NoSign].into(), scaled, 384);
    area
}

pub fn q8_shapes() -> Area {
    let mut area = Area { cases: Vec::new(), ..q8_area() };
    cases::add_split(&mut area);
    for (rows, inner, columns) in [(1, 32, 1), (17, 64, 36), (33, 96, 130), (19, 1536, 72), (270, 160, 264)] {
        let make = move || match columns {
            1 => cases::variants(Problem::exact(rows, inner, columns)).into(),
            _ => cases::epilogues(|| Problem::exact(rows, inner, columns)),
        };
        area.sweep(format!("{rows} rows, {columns} columns"), inner, [PastEnd], make);
    }
    area
}

fn sized(mut problem: Problem, factor: impl Fn(usize) -> f32) -> Problem {
    let groups = problem.weight.chunks_mut(Q8::GROUP).enumerate();
    groups.for_each(|(g, group)| group.iter_mut().for_each(|w| *w *= factor(g)));
    problem
}

fn apart() -> Problem {
    sized(Problem::random(9, 384, 40), |g| 10f32.powi((g % 5) as i32 - 2))
}

fn extreme() -> Problem {
    let mut problem = sized(Problem::random(5, 64, 40), |g| if g % 2 == 0 { 6e4 } else { 0.008 });
    // Larger inputs compensate small weights.
    let size = |k: usize| if (k / Q8::GROUP).is_multiple_of(2) { 1e-3 } else { 8e3 };
    problem.x.iter_mut().enumerate().for_each(|(k, x)| *x *= size(k));
    problem
}

/// Row r has only channel r.
fn one_hot() -> Problem {
    let mut problem = Problem::random(96, 96, 8);
    problem.x.iter_mut().enumerate().for_each(|(i, x)| *x = if i / 96 == i % 96 { 1.0 } else { 0.0 });
    problem.weight.iter_mut().for_each(|w| *w = (0.5 + 0.5 * w.abs()) * w.signum());
    sized(problem, |g| 2f32.powi(g as i32 % 3))
}

impl Problem {
    pub(super) fn q8(&self) -> Q8 {
        Q8::round(&self.weight).expect("weights within f16")
    }

    pub(super) fn wrongly_expanded(&self, fault: Fault) -> Vec<f64> {
        let Q8 { integers, scales } = self.q8();
        let groups = self.inner / Q8::GROUP;
        let weight = |i: usize| {
            let (column, k) = (i / self.inner, i % self.inner);
            let at = if matches!(fault, Fault::TurnedTerms) { i / 4 * 4 + 3 - i % 4 } else { i };
            let group = if matches!(fault, Fault::NextScale) { (k / Q8::GROUP + 1) % groups } else { k / Q8::GROUP };
            let integer = match fault {
                Fault::NoSign => f64::from(integers[at] as u8),
                _ => f64::from(integers[at]),
            };
            integer * f64::from(scales[column * groups + group].to_f32())
        };
        (0..integers.len()).map(weight).collect()
    }
}
