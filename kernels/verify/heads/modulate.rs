use crate::{ops::layer_norm::normed_errors, prelude::*};
use zipsplat::kernels::heads::Modulate;
use zipsplat_reference::{heads::modulate::modulate, ops::layer_norm::layer_norm};

const REASON: &str =
    "the norm's error as in ops/layer_norm, times 1 + scale and gate; six roundings of products and sums more";

const EPS: f32 = 1e-6;

struct Problem {
    width: usize,
    x: Vec<f32>,
    /// Rows of shift, scale and gate.
    modulation: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    NoShift,
    NoScale,
    NoGate,
    NoResidual,
    ScaleWithoutOne,
    SwappedParts,
    NoEpsilon,
    NeighborRow,
    Half,
}

impl Problem {
    fn new(rows: usize, width: usize, value: fn(f32) -> f32) -> Self {
        let mut noise = Noise::new((rows * 31 + width) as u64);
        let x = noise.values(rows * width).into_iter().map(value).collect();
        Self { width, x, modulation: noise.values(3 * rows * width) }
    }

    fn with(&self, eps: f64, part: impl Fn(usize, f64) -> f64) -> Vec<f64> {
        let part_of = |(i, x): (usize, &f32)| part(i / self.width % 3, f64::from(*x));
        let modulation: Vec<f64> = self.modulation.iter().enumerate().map(part_of).collect();
        modulate(&widen(&self.x), &modulation, self.width, eps)
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let (mut trial, rows) = (Trial::new(device), self.x.len() / self.width);
        let out = trial.output::<f32>(self.x.len());
        let kernel = Modulate {
            source: trial.input(&self.x),
            modulation: trial.input(&self.modulation),
            out,
            rows: rows as u32,
            width: self.width as u32,
            eps: EPS,
        };
        trial.rec.dispatch_groups(kernel, rows);
        trial.result(out)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let (x, eps, width) = (widen(&self.x), f64::from(EPS), self.width);
        let normed = layer_norm(&x, &vec![1.0; width], &vec![0.0; width], eps);
        let errors: Vec<f64> = x.chunks(width).flat_map(|row| normed_errors(row, eps)).collect();
        let bound = |i: usize| {
            let part = |part: usize| f64::from(self.modulation[i / width * 3 * width + part * width + i % width]);
            let (shift, scale, gate) = (part(0).abs(), 1.0 + part(1).abs(), part(2).abs());
            let size = normed[i].abs() + errors[i];
            gate * (errors[i] * scale + gamma(6) * (size * scale + shift)) + gamma(6) * x[i].abs() + TINY
        };
        [self.with(eps, |_, x| x), (0..x.len()).map(bound).collect()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let eps = f64::from(EPS);
        let without = |which: usize| self.with(eps, |part, x| if part == which { 0.0 } else { x });
        match fault {
            Fault::NoShift => without(0),
            Fault::NoScale => without(1),
            Fault::NoGate => without(2),
            Fault::NoResidual => truth.iter().zip(&self.x).map(|(y, &x)| y - f64::from(x)).collect(),
            Fault::ScaleWithoutOne => self.with(eps, |part, x| if part == 1 { x - 1.0 } else { x }),
            Fault::SwappedParts => {
                let rows = self.modulation.chunks(3 * self.width);
                let swapped = rows.flat_map(|row| [&row[self.width..], &row[..self.width]].concat());
                Self { modulation: swapped.collect(), x: self.x.clone(), ..*self }.with(eps, |_, x| x)
            }
            Fault::NoEpsilon => self.with(0.0, |_, x| x),
            Fault::NeighborRow => shifted(truth, self.width),
            Fault::Half => halves(truth),
        }
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("heads/modulate", "channels", Mode::ONLY_EXACT, REASON);
    let all =
        || Catches::from([NoShift, NoScale, NoGate, NoResidual, ScaleWithoutOne, SwappedParts, NeighborRow, Half]);
    for (rows, width) in [(2, 5), (3, 64), (5, 1000), (9, 2048)] {
        area.add("random", width, all(), move || Problem::new(rows, width, |r| r));
    }
    area.add("variance of epsilon", 128, [NoEpsilon, NoGate], || Problem::new(4, 128, |r| 2e-3 * r));
    area.add("mean 1e3", 128, [NoGate, NoResidual], || Problem::new(4, 128, |r| 1e3 + r));
    let rows = GROUP_FOLD as usize + 9;
    area.add("rows beyond a fold of workgroups", rows, [NeighborRow], move || Problem::new(rows, 4, |r| r));
    area
}
