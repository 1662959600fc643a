use super::{
    Fault::{self, *},
    Problem, Residual,
};
use crate::prelude::*;
use zipsplat::{kernels::limits::LINEAR_ROWS, ops::Activation};

const REASON: &str = "|error| <= gamma_(n+1) (|x| |W| + |b|) in every element, whatever the order of the sum of its n terms that are \
    not 0 (Higham, section 3.5), carried through the activation's slope, plus Vulkan's limits for exp and division. Whole \
    numbers whose sums stay below 2^24 are added exactly in any order. The truth is that of the factors as the mode holds \
    them, 11 or 8 bits or 8-bit integers; sums of integers are exact, and only their scales are rounded";

const SUMS: [Fault; 3] = [HalfSum, NeighborColumn, NeighborRow];

pub fn area() -> Area {
    let mut area = Area::new("ops/linear", "terms of a sum (K)", Mode::ALL, REASON);
    let mut add = |name: &str, catches: Catches<Fault>, make: fn() -> Problem, size: usize| {
        area.add(name, size, catches, make);
    };
    let terms = || Catches::from(SUMS).and(&[LastTerm, CutIntegers, Unsigned]);
    add("random", terms().and(&[HalfFactors, NoBias]), || random(4), 4);
    add("random", terms().and(&[HalfFactors, NoBias]), || random(68), 68);
    add("random", terms(), || random(384), 384);
    add("random", terms(), || random(588), 588);
    add("random", Catches::from(SUMS).and(&[TermsFrom(1504)]), || random(1536), 1536);
    // With many rounding terms, only whole numbers reveal 11-bit sums.
    add("random", [NeighborColumn, NeighborRow, TermsFrom(3968)].into(), || random(4096), 4096);
    let halves = [NeighborColumn, NeighborRow, TermsFrom(4096), TermsFrom(7680)];
    add("random", halves.into(), || random(8192), 8192);
    let exact = || Catches::from(SUMS).and(&[LastTerm]);
    add("whole numbers", exact().and(&[TermsFrom(4095)]), || whole(4096), 4096);
    add("whole numbers", exact().and(&[TermsFrom(4096), TermsFrom(8191)]), || whole(8192), 8192);
    add("0 rows, 8 columns", [PastEnd].into(), || Problem::random(0, 12, 8), 12);
    add("1 row, 1 column", [HalfSum, LastTerm, PastEnd].into(), || Problem::random(1, 12, 1), 12);
    let edges = || Catches::from(SUMS).and(&[LastRow, LastColumn, PastEnd]);
    add("33 rows, 5 columns", edges(), || Problem::random(33, 12, 5), 12);
    add("16 rows, 130 columns", edges(), || Problem::random(16, 12, 130), 12);
    add("300 rows, 264 columns", edges(), || Problem::random(300, 12, 264), 12);
    let folded = || Problem::random(GROUP_FOLD as usize + 9, 4, 8);
    add("rows beyond a fold of workgroups", edges().and(&[Folded]), folded, 4);
    add("sums that cancel, condition 1e5", Catches::from(SUMS).and(&[LastTerm, AnyTerm]), cancelling, 512);
    add("outlier channels of 1e4", [HalfSum, TermsFrom(900), NeighborRow].into(), outliers, 1536);
    add("one channel at a time", [AnyTerm, NeighborColumn, NeighborRow, HalfFactors].into(), || one_hot(68, 68), 68);
    let few = || Catches::from([AnyTerm, LastTerm, NeighborColumn, NeighborRow, HalfFactors]);
    add("every channel in a sum of 64", few(), || one_hot(4096, 64), 4096);
    add("every channel in a sum of 64", few(), || one_hot(8192, 128), 8192);
    add("subnormal inputs", [NoBias].into(), || scaled(1e-40, Problem::random(5, 64, 40)), 64);
    add("sums beyond the largest f16", SUMS.into(), || scaled(1e4, Problem::random(5, 256, 40)), 256);
    add("GELU", [NoActivation, NoBias, NeighborColumn].into(), || gelu(Problem::random(21, 384, 64)), 384);
    add("GELU of every value from -10 to 10", [HalfResult, NoActivation, TanhGelu].into(), || gelu(alone()), 4);
    add("GELU far from zero", [HalfResult, NoActivation].into(), || gelu(far(12.0, 40)), 64);
    add("SwiGLU", [NoActivation, NoBias, SwappedGate].into(), || swiglu(Problem::random(21, 384, 64)), 384);
    let gated = || Catches::from([HalfResult, NoActivation]);
    add("SwiGLU of every value from -10 to 10", gated().and(&[SwappedGate]), || swiglu(alone()), 4);
    add("SwiGLU far from zero", gated().and(&[OverflowingExp]), || swiglu(far(60.0, 40)), 64);
    let large = [HalfResult, OverflowingExp];
    add("SwiGLU products beyond the largest f16", large.into(), || swiglu(far(1e3, 9)), 64);
    let scaling = [NoScale, NoResidual, ScaledResidual, PastEnd];
    let scaled = || Problem { scaled: true, residual: Residual::InPlace, ..Problem::random(37, 384, 56) };
    add("layer scale and residual in place", scaling.into(), scaled, 384);
    area
}

/// Results of both types, and bindings instead of addresses.
pub(super) fn variants(problem: Problem) -> [Problem; 3] {
    let without_addresses: fn(&mut Limits) = |limits| limits.addresses = false;
    [Problem { limits: without_addresses, ..problem.clone() }, Problem { stored: true, ..problem.clone() }, problem]
}

pub(super) fn epilogues(problem: impl Fn() -> Problem) -> Vec<Problem> {
    let mut all = Vec::new();
    for activation in [Activation::None, Activation::Gelu] {
        let scales = [false, true].into_iter();
        for (scaled, residual) in scales.flat_map(|scaled| [Residual::None, Residual::Apart].map(|r| (scaled, r))) {
            all.extend(variants(Problem { activation, scaled, residual, ..problem() }));
        }
    }
    all.push(Problem { scaled: true, residual: Residual::InPlace, ..problem() });
    if problem().columns.is_multiple_of(4) {
        all.extend(variants(swiglu(problem())));
    }
    all
}

/// Few results of 16-bit factors split sums.
pub(super) fn add_split(area: &mut Area) {
    area.sweep("split into parts", 3104, [PastEnd], || epilogues(|| Problem::exact(11, 3104, 40)));
}

pub fn shapes() -> Area {
    let mut area = Area { cases: Vec::new(), ..area() };
    for rows in [1, 7, 8, 9, 15, 16, 17, 31, 33, 65] {
        let columns = [1, 2, 3, 4, 5, 31, 32, 33, 63, 65, 127, 128, 129, 258];
        let make = move || columns.iter().flat_map(|&columns| variants(Problem::exact(rows, 12, columns))).collect();
        area.sweep(format!("{rows} rows around tiles"), 12, [NoBias, PastEnd], make);
    }
    for inner in [4, 8, 60, 64, 68, 128, 588, 1536, 4096, 6144] {
        let make = move || variants(Problem::exact(19, inner, 72)).into();
        area.sweep("72 columns", inner, [NeighborColumn, PastEnd], make);
    }
    for columns in [4, 36, 132] {
        let make = move || epilogues(|| Problem::exact(21, 24, columns));
        area.sweep(format!("epilogues of {columns} columns"), 24, [PastEnd], make);
    }
    let parts = || {
        let limits: fn(&mut Limits) = |limits| limits.max_binding_bytes = 64 << 10;
        let all = epilogues(|| Problem::exact(1000, 64, 96)).into_iter();
        all.map(|problem| Problem { limits, ..problem }).collect()
    };
    area.sweep("rows bound in parts", 64, [PastEnd], parts);
    let integers = || {
        let shapes = [(1, 8, 8), (7, 24, 32), (9, 72, 40), (33, 64, 136), (70, 96, 264), (3, 4096, 24), (130, 40, 72)];
        shapes.iter().flat_map(|&(rows, inner, columns)| variants(Problem::exact(rows, inner, columns))).collect()
    };
    area.sweep("shapes of dot products", 8, [PastEnd], integers);
    let rows = LINEAR_ROWS as usize * 65_536 + 1;
    let many = move || Problem::exact(rows, 4, 4);
    area.add("rows beyond the most workgroups", rows, [Folded, PastEnd], many);
    add_split(&mut area);
    area
}

fn random(inner: usize) -> Problem {
    Problem::random(17, inner, 40)
}

fn gelu(problem: Problem) -> Problem {
    Problem { activation: Activation::Gelu, ..problem }
}

fn swiglu(problem: Problem) -> Problem {
    Problem { activation: Activation::SwiGlu, ..problem }
}

fn scaled(factor: f32, mut problem: Problem) -> Problem {
    problem.x.iter_mut().for_each(|x| *x *= factor);
    problem
}

/// Overflows and underflows exp.
fn far(factor: f32, rows: usize) -> Problem {
    scaled(factor, Problem::random(rows, 64, 64))
}

/// Nonzero whole numbers up to 7: exact in f16, bf16 and f32 sums, and far from 8-bit ties.
fn whole(inner: usize) -> Problem {
    let mut problem = Problem { whole: true, ..random(inner) };
    for x in problem.x.iter_mut().chain(&mut problem.weight).chain(&mut problem.bias) {
        *x = (x.abs() * 7.0).ceil().max(1.0) * x.signum();
    }
    problem
}

/// One input per sum, from -10 to 10; gates and values read different channels.
fn alone() -> Problem {
    let mut problem = Problem::random(2001, 4, 8);
    problem.x.iter_mut().enumerate().for_each(|(i, x)| *x = ((i / 4 * (1 + i % 4)) % 2001) as f32 / 100.0 - 10.0);
    problem.weight.iter_mut().enumerate().for_each(|(i, w)| *w = if i / 4 % 4 == (i + i / 16) % 4 { 1.0 } else { 0.0 });
    problem.bias.fill(0.0);
    problem
}

/// Products of whole numbers from 64 to 127 cancel, except one pair in 32. Row maxima are 127,
/// exact in 8-bit integers.
fn cancelling() -> Problem {
    let mut problem = Problem { whole: true, ..Problem::random(9, 512, 40) };
    let mut noise = Noise::new(73);
    let mut large = || noise.uniform(64.0, 128.0).floor();
    for (i, pair) in problem.weight.chunks_mut(2).enumerate() {
        let w = if i % 256 == 3 { 127.0 } else { large() };
        pair.copy_from_slice(&[w, -w]);
    }
    for (i, pair) in problem.x.chunks_mut(2).enumerate() {
        let x = if i % 256 == 3 { 127.0 } else { large() };
        pair.copy_from_slice(&[x, if i % 32 == 5 { (x - 1.0).max(64.0) } else { x }]);
    }
    problem.bias.fill(0.0);
    problem
}

fn outliers() -> Problem {
    let mut problem = Problem::random(9, 1536, 40);
    for row in problem.x.chunks_mut(1536) {
        (row[7], row[900]) = (1e4 * row[7].signum(), -7e3);
    }
    problem
}

/// Row r has the channels r, r + rows, r + 2 rows...: few terms reveal a wrong index.
fn one_hot(inner: usize, rows: usize) -> Problem {
    let mut problem = Problem::random(rows, inner, 8);
    problem.x.iter_mut().enumerate().for_each(|(i, x)| *x = if i / inner == i % inner % rows { 1.0 } else { 0.0 });
    problem.weight.iter_mut().for_each(|w| *w = (0.5 + 0.5 * w.abs()) * w.signum());
    problem
}
