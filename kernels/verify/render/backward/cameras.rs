use super::added_to;
use crate::prelude::*;
use zipsplat::kernels::render::CamerasBackward;

const REASON: &str = "a sum of n numbers in any order: gamma_n of the sum of their magnitudes";

/// Numbers of two cameras.
const NUMBERS: usize = 20;
const BEFORE: f32 = 0.75;

/// `[rows, NUMBERS]`.
struct Problem(Vec<f32>);

#[derive(Clone, Copy, Debug)]
enum Fault {
    HalfSums,
    Overwritten,
    LastRow,
    NeighborNumber,
}

impl Problem {
    fn terms(&self, number: usize) -> impl Iterator<Item = f64> {
        self.0.iter().skip(number).step_by(NUMBERS).map(|x| f64::from(*x))
    }

    fn sum(&self, number: usize) -> f64 {
        f64::from(BEFORE) + self.terms(number).sum::<f64>()
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let parts = trial.input(&self.0);
        let d_cameras = added_to(&mut trial, NUMBERS, BEFORE);
        let (rows, numbers) = ((self.0.len() / NUMBERS) as u32, NUMBERS as u32);
        trial.rec.dispatch_groups(CamerasBackward { parts, d_cameras, rows, numbers }, NUMBERS);
        trial.result(d_cameras)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let rows = self.0.len() / NUMBERS;
        let magnitudes = |number| f64::from(BEFORE) + self.terms(number).map(f64::abs).sum::<f64>();
        let bound = |number| gamma(by_lanes(rows) + 1) * magnitudes(number);
        [(0..NUMBERS).map(|number| self.sum(number)).collect(), (0..NUMBERS).map(bound).collect()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let one = |number: usize| match fault {
            Fault::HalfSums => self.terms(number).fold(f64::from(BEFORE), |sum, x| half(sum + x)),
            Fault::Overwritten => truth[number] - f64::from(BEFORE),
            Fault::LastRow => truth[number] - self.terms(number).last().unwrap_or(0.0),
            Fault::NeighborNumber => truth[(number + 1) % NUMBERS],
        };
        (0..NUMBERS).map(one).collect()
    }
}

pub fn area() -> Area {
    use Fault::*;
    let all = [HalfSums, Overwritten, LastRow, NeighborNumber];
    let noise = |rows: usize| move || Problem(Noise::new(rows as u64).values(rows * NUMBERS));
    let mut area = Area::new("render/cameras_backward", "rows", Mode::ONLY_EXACT, REASON);
    for rows in [1, 7, 129, 4097] {
        area.add("random of +-1", rows, all, noise(rows));
    }
    let cancelling = || {
        let values = Noise::new(3).values(1001 * NUMBERS);
        // Large numbers cancel, except in the last row.
        let opposite = |i: usize| if (i / NUMBERS).is_multiple_of(2) { 1e6 } else { -1e6 };
        let large = |i: usize| opposite(i) * (1.0 + values[i / (2 * NUMBERS) * NUMBERS + i % NUMBERS].abs());
        Problem((0..values.len()).map(large).collect())
    };
    area.add("opposites of 1e6", 1001, [HalfSums, LastRow], cancelling);
    let none = || Problem(vec![0.0; 65 * NUMBERS]);
    area.add("nothing visible", 65, [Overwritten], none);
    area
}
