use crate::prelude::*;
use zipsplat::refine::{Adam, record_anisotropy_limit};
use zipsplat_reference::refine::anisotropy::limited;

const REASON: &str = "running error analysis: two products round once, exp 3 + 2|x| units; other scales stay exactly";

const RATIO: f32 = 5.0;
/// Half the schedule's.
const RATE: f32 = 0.25;
const SHARE: f32 = 0.5;

/// `[_, 3]`.
struct Problem(Vec<f32>);

#[derive(Clone, Copy, Debug)]
enum Fault {
    Unlimited,
    BySmallest,
    /// Without the rate.
    AtOnce,
    NoRatio,
    Uniform,
    NeighborGaussian,
}

impl Problem {
    /// Within a factor `spread` of 0.01.
    fn new(count: usize, spread: f32) -> Self {
        Self(Noise::new(count as u64).values(3 * count).iter().map(|x| 0.01 * spread.powf(*x)).collect())
    }

    fn row(&self, i: usize) -> [f64; 3] {
        [0, 1, 2].map(|k| self.0[3 * i + k].into())
    }

    fn errors(&self, i: usize) -> [f64; 3] {
        let exact = self.row(i).map(Bounded::exact);
        let [x, y, z] = exact;
        let middle = x.min(y).max(x.max(y).min(z));
        let shrunk = x.max(y).max(z) * Bounded::exact(-RATE).exp();
        let limit = (Bounded::exact(RATIO) * middle).max(shrunk);
        exact.map(|scale| if scale.value + limit.error < limit.value { 0.0 } else { limit.error })
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let scales = trial.input(&self.0);
        let schedule = trial.input(&Adam::default().schedule(RATE / SHARE, 1));
        record_anisotropy_limit(&mut trial.rec, scales, schedule, RATIO, SHARE, self.0.len() / 3);
        trial.result(scales)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let rows = 0..self.0.len() / 3;
        let truth = rows.clone().flat_map(|i| limited(self.row(i), RATIO.into(), RATE.into())).collect();
        [truth, rows.flat_map(|i| self.errors(i)).collect()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let count = truth.len() / 3;
        let right = |i: usize| [0, 1, 2].map(|k| truth[3 * i + k]);
        let row = |i: usize| {
            let scales = self.row(i);
            let [smallest, middle, largest] = sorted(scales);
            match fault {
                Fault::Unlimited => scales,
                Fault::BySmallest => {
                    let limit = (f64::from(RATIO) * smallest).max(largest * f64::from(-RATE).exp());
                    scales.map(|scale| scale.min(limit))
                }
                Fault::AtOnce => scales.map(|scale| scale.min(f64::from(RATIO) * middle)),
                Fault::NoRatio => scales.map(|scale| scale.min(largest * f64::from(-RATE).exp())),
                Fault::Uniform => scales.map(|scale| scale * sorted(right(i))[2] / largest),
                Fault::NeighborGaussian => right((i + 1) % count),
            }
        };
        (0..count).flat_map(row).collect()
    }
}

fn sorted(mut scales: [f64; 3]) -> [f64; 3] {
    scales.sort_by(f64::total_cmp);
    scales
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("refine/anisotropy", "values", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, count, spread, catches: Catches<Fault>| {
        area.add(name, count, catches, move || Problem::new(count, spread));
    };
    let all = Catches::from([Unlimited, BySmallest, AtOnce, NoRatio, Uniform, NeighborGaussian]);
    add("needles", 4097, 1e3, all);
    add("needles of 1e-9 to 1e5", 65, 1e7, [Unlimited, AtOnce, NoRatio, NeighborGaussian].into());
    add("round Gaussians", 64, 2.0, [NoRatio, NeighborGaussian].into());
    area
}
