use crate::prelude::*;
use zipsplat::ops::Norm;
use zipsplat_reference::ops::{add::add, layer_norm::layer_norm};

const REASON: &str = "the mean is off by d <= gamma mean|x|, of which the second pass takes back all but gamma mean|x - mean|; \
    the variance then by gamma (variance + d^2), relative to variance + epsilon (corrected two-pass algorithm: Chan, Golub \
    and LeVeque 1983); plus Vulkan's limits for root and division. gamma counts the additions that a term goes through: \
    those of a lane, of which there are 4 at least, then those of the lanes";

const EPS: f32 = 1e-6;

/// Returns bounds without weight and bias.
pub fn normed_errors(row: &[f64], eps: f64) -> Vec<f64> {
    let n = row.len() as f64;
    let mean_of = |f: &dyn Fn(f64) -> f64| row.iter().map(|&x| f(x)).sum::<f64>() / n;
    // A sum and a division, counted as five roundings.
    let additions = by_lanes(row.len());
    let sum = gamma(additions + 6);
    let mean = mean_of(&|x| x);
    let variance = mean_of(&|x| (x - mean).powi(2));
    let first = sum * mean_of(&f64::abs) + 2.0 * TINY;
    let spread = mean_of(&|x| (x - mean).abs()) + first;
    let second = sum * spread + 2.0 * TINY;
    let variance_error = gamma(additions + 10) * (variance + first * first) + 2.0 * (first + second) * second + TINY;
    let scale = |variance: f64| 1.0 / (variance.max(0.0) + eps).sqrt();
    let own = ROOT + DIVISION + U;
    let [lowest, highest] = [variance + variance_error, variance - variance_error].map(scale);
    let (exact, highest) = (scale(variance), highest * (1.0 + own));
    let scale_error = (exact - lowest * (1.0 - own)).max(highest - exact);
    let error = |&x: &f64| {
        let d = (x - mean).abs();
        let d_error = 2.0 * U * (d + first) + second;
        d_error * highest + d * scale_error + 2.0 * U * (d + d_error) * highest + TINY * (1.0 + highest)
    };
    row.iter().map(error).collect()
}

pub fn affine_errors(errors: &[f64], truth: &[f64], weight: &[f32], bias: &[f32]) -> Vec<f64> {
    let columns = weight.iter().zip(bias).map(|(&w, &b)| (f64::from(w.abs()), f64::from(b.abs())));
    let error = |(i, (w, b)): (usize, (f64, f64))| {
        let carried = w * errors[i];
        carried + 2.0 * U * (truth[i].abs() + b + carried) + TINY
    };
    columns.enumerate().map(error).collect()
}

#[derive(Clone)]
struct Problem {
    width: usize,
    eps: f32,
    x: Vec<f32>,
    addend: Option<Vec<f32>>,
    /// Values of one size about 0, whose rounding tests hold to that of random sums.
    is_tame: bool,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
pub enum Fault {
    /// Variance as the difference of two f32 sums.
    OnePass,
    UncorrectedMean,
    HalfSum,
    LastChannel,
    Unbiased,
    NoEpsilon,
    NoBias,
    NeighborRow,
    Folded,
    OverflowingSquares,
}

impl Fault {
    fn moments(self, row: &[f64]) -> [f64; 2] {
        let n = row.len() as f64;
        let summed = |round: fn(f64) -> f64, values: &mut dyn Iterator<Item = f64>| {
            round(values.fold(0.0, |sum, value| round(sum + value)) / n)
        };
        let single: fn(f64) -> f64 = |x| f64::from(x as f32);
        let plain: fn(f64) -> f64 = |x| x;
        let (round, used) = match self {
            Fault::OnePass | Fault::UncorrectedMean => (single, row),
            Fault::HalfSum => (half as fn(f64) -> f64, row),
            Fault::LastChannel => (plain, &row[..row.len() - 1]),
            _ => (plain, row),
        };
        let mean = summed(round, &mut used.iter().copied());
        let squares = |about: f64| summed(round, &mut used.iter().map(|x| round((x - about).powi(2))));
        let variance = match self {
            Fault::OnePass => single(squares(0.0) - single(mean * mean)).max(0.0),
            Fault::Unbiased => squares(mean) * n / (n - 1.0),
            Fault::OverflowingSquares if row.iter().any(|x| (x - mean).powi(2) > f32::MAX.into()) => f64::INFINITY,
            _ => squares(mean),
        };
        [mean, variance]
    }

    pub fn normed(self, rows: &[f64], [weight, bias]: [&[f32]; 2], eps: f64) -> Vec<f64> {
        let row = |row: &[f64]| {
            let [mean, variance] = self.moments(row);
            let scale = 1.0 / (variance + eps).sqrt();
            let value = |c: usize| (row[c] - mean) * scale * f64::from(weight[c]) + f64::from(bias[c]);
            (0..row.len()).map(value).collect::<Vec<_>>()
        };
        rows.chunks(weight.len()).flat_map(row).collect()
    }
}

impl Problem {
    fn new(rows: usize, width: usize, value: fn(f32, usize) -> f32) -> Self {
        let mut noise = Noise::new(width as u64);
        let (weight, bias) = (noise.values(width), noise.values(width));
        let values = Noise::new(5).values(rows * width).into_iter().enumerate();
        let x = values.map(|(i, r)| value(r, i % width)).collect();
        Self { width, eps: EPS, x, addend: None, is_tame: false, weight, bias }
    }

    fn rows(&self) -> Vec<f64> {
        self.addend.as_ref().map_or(widen(&self.x), |addend| add(&widen(&self.x), &widen(addend)))
    }

    fn normed(&self, fault: Fault) -> Vec<f64> {
        let eps = if matches!(fault, Fault::NoEpsilon) { 0.0 } else { f64::from(self.eps) };
        fault.normed(&self.rows(), [&self.weight, &self.bias], eps)
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let (weight, bias) = (trial.input(&self.weight), trial.input(&self.bias));
        let norm = Norm { weight, bias, width: self.width, eps: self.eps };
        let rows = |tensor, element| Rows { tensor, count: self.x.len() / self.width, width: self.width, element };
        let mut input = |values: &Vec<f32>| rows(trial.input(values), Element::F32);
        let (source, addend) = (input(&self.x), self.addend.as_ref().map(input));
        let out = trial.output_of(mode.factor, self.x.len());
        norm.record(&mut trial.rec, source, addend, rows(out, mode.factor), Norm::ALL);
        trial.result_of(mode.factor, out)
    }

    fn truth(&self, mode: Mode) -> [Vec<f64>; 2] {
        let (x, eps) = (self.rows(), f64::from(self.eps));
        let truth = layer_norm(&x, &self.weight, &self.bias, eps);
        let added = self.addend.as_ref().map_or(0.0, |_| U);
        let bounds = |(row, truth): (&[f64], &[f64])| {
            let mut errors = normed_errors(row, eps);
            // A rounded sum moves its row by as much, relative to its spread.
            let largest = row.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            let mean = row.iter().sum::<f64>() / row.len() as f64;
            let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / row.len() as f64;
            errors.iter_mut().for_each(|error| *error += 4.0 * added * largest / (variance + eps).sqrt());
            affine_errors(&errors, truth, &self.weight, &self.bias)
        };
        let rows = x.chunks(self.width).zip(truth.chunks(self.width));
        let bounds = rows.flat_map(bounds).zip(&truth).map(|(bound, truth)| mode.stored(*truth, bound)).collect();
        [truth, bounds]
    }

    /// Two sums over a row, a root and a division.
    fn typical(&self, mode: Mode) -> Tolerance {
        let sums = Tolerance::sum_of(self.width).and(Tolerance::ELEMENTWISE).stored_in(mode.factor);
        if self.is_tame { sums } else { Tolerance::ANY }
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let width = self.width;
        match fault {
            Fault::NoBias => truth.iter().enumerate().map(|(i, y)| y - f64::from(self.bias[i % width])).collect(),
            Fault::NeighborRow => shifted(truth, width),
            Fault::Folded => (0..truth.len()).map(|i| truth[i % (GROUP_FOLD as usize * width)]).collect(),
            _ => self.normed(fault),
        }
    }
}

/// Around any subgroup's size and its multiples, and of the largest networks.
pub fn shapes() -> Area {
    use Fault::*;
    let of = |rows: usize, width: usize| {
        let random = Problem { is_tame: true, ..Problem::new(rows, width, |r, _| r) };
        let addend = Some(Noise::new(2).values(rows * width));
        [Problem { addend, eps: 1e-5, ..random.clone() }, random]
    };
    let widths = [1, 3, 4, 7, 8, 9, 31, 32, 33, 63, 64, 65, 127, 384, 1536, 3073];
    let mut area = Area { cases: Vec::new(), modes: Mode::STORED, ..area() };
    for width in widths {
        area.sweep("random", width, [NoBias], move || [0, 1, 5].map(|rows| of(rows, width)).concat());
    }
    let many = move || of(65_537, 4).into();
    area.sweep("rows beyond the most workgroups", 65_537, [Folded, NeighborRow], many);
    let near =
        move || of(20, 64).map(|p| Problem { x: p.x.iter().map(|x| 2e-3 * x).collect(), addend: None, ..p }).into();
    area.sweep("variances near both epsilons", 64, [NoEpsilon], near);
    area
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("ops/layer_norm", "channels", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, width: usize, catches: Catches<Fault>, value: fn(f32, usize) -> f32| {
        area.add(name, width, catches, move || Problem::new(9, width, value));
    };
    add("random", 1, [NoBias].into(), |r, _| r);
    add("mean 1e4, spread 1e-2", 1, [NoBias].into(), |r, _| 1e4 + 1e-2 * r);
    for width in [3, 64, 384, 1536, 4096] {
        let random = Catches::from([NoBias, HalfSum, LastChannel, NeighborRow]);
        // A large last channel makes its omission detectable.
        let last: fn(f32, usize) -> f32 =
            if width > 1000 { |r, c| if c % 512 == 511 { 20.0 * r } else { r } } else { |r, _| r };
        add("random", width, if width < 1000 { random.and(&[Unbiased]) } else { random }, last);
        let offset = Catches::from([OnePass, HalfSum, NeighborRow]);
        let offset = if width < 64 { offset } else { offset.and(&[UncorrectedMean]) };
        match width {
            // Rounding many terms may cost more than a hundredth.
            4096 => add("mean 1e4, spread 1e-1", width, offset, |r, _| 1e4 + 1e-1 * r),
            _ => add("mean 1e4, spread 1e-2", width, offset, |r, _| 1e4 + 1e-2 * r),
        }
    }
    add("constant rows of 0", 64, [NoEpsilon].into(), |_, _| 0.0);
    add("constant rows of -3", 64, [NoEpsilon].into(), |_, _| -3.0);
    add("constant rows of 12345.678", 1536, [OnePass, NoEpsilon, UncorrectedMean].into(), |_, _| 12_345.678);
    add("variance of epsilon", 384, [NoEpsilon, LastChannel].into(), |r, _| 2e-3 * r);
    add("one channel of 1e4", 1536, [HalfSum, NoBias].into(), |r, c| if c == 77 { 1e4 } else { r });
    add("first channel of 1e6", 384, [HalfSum, NoBias].into(), |r, c| if c == 0 { 1e6 } else { r });
    add("values of 1e4", 1536, [HalfSum, NeighborRow].into(), |r, _| 1e4 * r);
    add("values of 1e15", 64, [HalfSum, LastChannel].into(), |r, _| 1e15 * r);
    add("values of 1e25", 64, [OverflowingSquares, LastChannel].into(), |r, _| 1e25 * r);
    add("subnormal rows", 64, [NoBias, NoEpsilon].into(), |r, _| 1e-39 * r);
    let rows = GROUP_FOLD as usize + 9;
    let folded = || Problem::new(GROUP_FOLD as usize + 9, 4, |r, _| r);
    area.add("rows beyond a fold of workgroups", rows, [Folded, NeighborRow], folded);
    area
}
