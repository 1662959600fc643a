use crate::prelude::*;
use zipsplat::refine::{Adam, Space, record_adam};
use zipsplat_reference::refine::adam::Adam as Reference;

const REASON: &str = "running error analysis of a step in the stored value: products and sums round once, the root and the division have \
    Vulkan's limits, exp 3 + 2|x| units; what is not finite moves nothing, exactly";

const ADAM: Adam = Adam { beta1: 0.9, beta2: 0.999, eps: 1e-8 };
/// Half the schedule's.
const RATE: f32 = 0.03125;
const SHARE: f32 = 0.5;

struct Problem {
    space: Space,
    step: u32,
    values: Vec<f32>,
    gradient: Vec<f32>,
    moments: [Vec<f32>; 2],
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    Ascent,
    NoCorrection,
    SwappedDecays,
    NoEpsilon,
    /// Steps the value, not its logarithm or logit.
    WrongSpace,
    NoChainRule,
    NeighborGradient,
    NeighborValue,
    Poisoned,
}

impl Problem {
    fn new(space: Space, step: u32, count: usize, gradient: fn(f32) -> f32) -> Self {
        let mut noise = Noise::new(count as u64 + u64::from(step));
        let values = noise.values(count).iter().map(|x| 0.5 + 0.4 * x).collect();
        let gradient = noise.values(count).into_iter().map(gradient).collect();
        let before = if step == 1 { 0.0 } else { 1.0 };
        let first: Vec<f32> = noise.values(count).iter().map(|x| before * x).collect();
        let second = first.iter().zip(noise.values(count)).map(|(m, x)| m * m * (1.5 + x)).collect();
        Self { space, step, values, gradient, moments: [first, second] }
    }

    fn stepped(&self, i: usize, fault: Option<Fault>) -> [f64; 3] {
        let (p, mut g) = (f64::from(self.values[i]), f64::from(self.gradient[i]));
        let moments = [0, 1].map(|k| f64::from(self.moments[k][i]));
        let (mut step, mut betas, mut eps, mut space) =
            (self.step as i32, [ADAM.beta1, ADAM.beta2].map(f64::from), f64::from(ADAM.eps), self.space);
        match fault {
            Some(Fault::NeighborGradient) => g = self.gradient[(i + 1) % self.gradient.len()].into(),
            Some(Fault::Ascent) => g = -g,
            Some(Fault::NoCorrection) => step = 1_000_000,
            Some(Fault::SwappedDecays) => betas.swap(0, 1),
            Some(Fault::NoEpsilon) => eps = 0.0,
            Some(Fault::WrongSpace) => space = Space::Linear,
            _ => {}
        }
        let slope = match self.space {
            _ if matches!(fault, Some(Fault::NoChainRule)) => 1.0,
            Space::Linear => 1.0,
            Space::Log => p,
            Space::Logit => p * (1.0 - p),
        };
        let square = (g * slope).powi(2);
        let is_still = square == 0.0 && moments == [0.0; 2];
        if is_still || !(square as f32).is_finite() {
            return [p, moments[0], moments[1]];
        }
        let there = match space {
            Space::Linear => p,
            Space::Log => p.ln(),
            Space::Logit => (p / (1.0 - p)).ln(),
        };
        let after = Reference { value: there, moments }.stepped(g * slope, step, RATE.into(), betas, eps);
        let value = match space {
            Space::Linear => after.value,
            Space::Log => after.value.exp(),
            Space::Logit => 1.0 / (1.0 + (-after.value).exp()),
        };
        [value, after.moments[0], after.moments[1]]
    }

    fn errors(&self, i: usize) -> [f64; 3] {
        let exact = Bounded::exact;
        let (p, one) = (exact(self.values[i]), exact(1.0));
        let g = match self.space {
            Space::Linear => exact(self.gradient[i]),
            Space::Log => exact(self.gradient[i]) * p,
            Space::Logit => exact(self.gradient[i]) * (p * (one - p)),
        };
        let is_still = g.value == 0.0 && self.moments.iter().all(|moment| moment[i] == 0.0);
        if is_still || !((g.value * g.value) as f32).is_finite() {
            return [0.0; 3];
        }
        let [beta1, beta2] = [exact(ADAM.beta1), exact(ADAM.beta2)];
        let corrections = ADAM.schedule(RATE, self.step).map(|x| Bounded::rounded(x.into()));
        let m = beta1 * exact(self.moments[0][i]) + (one - beta1) * g;
        let v = beta2 * exact(self.moments[1][i]) + (one - beta2) * g * g;
        let d = exact(RATE) * m * corrections[1] / ((v * corrections[2]).sqrt() + exact(ADAM.eps));
        let after = match self.space {
            Space::Linear => p - d,
            Space::Log => p * (-d).exp(),
            Space::Logit => p / (p + (one - p) * d.exp()),
        };
        [after.error, m.error, v.error]
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let mut trial = Trial::new(device);
        let [values, gradient, first, second] =
            [&self.values, &self.gradient, &self.moments[0], &self.moments[1]].map(|x| trial.input(x));
        let schedule = trial.input(&ADAM.schedule(RATE / SHARE, self.step));
        let len = self.values.len();
        record_adam(&mut trial.rec, ADAM, values, gradient, [first, second], schedule, SHARE, self.space, len);
        Ok(trial.results([values, first, second])?.concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let all = |of: &dyn Fn(usize) -> [f64; 3]| {
            let rows: Vec<[f64; 3]> = (0..self.values.len()).map(of).collect();
            (0..3).flat_map(|k| rows.iter().map(move |row| row[k])).collect()
        };
        [all(&|i| self.stepped(i, None)), all(&|i| self.errors(i))]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let count = self.values.len();
        let one = |i: usize| match fault {
            Fault::NeighborValue => truth[(i + 1) % truth.len()],
            Fault::Poisoned if !self.gradient[i % count].is_finite() => f64::NAN,
            Fault::Poisoned => truth[i],
            _ => self.stepped(i % count, Some(fault))[i / count],
        };
        (0..truth.len()).map(one).collect()
    }
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("refine/adam", "values", Mode::ONLY_EXACT, REASON);
    let mut add = |name: &str, space, step, count, catches: Catches<Fault>, gradient: fn(f32) -> f32| {
        let name = format!("{name}, {space:?}");
        area.add(name, count, catches, move || Problem::new(space, step, count, gradient));
    };
    for space in [Space::Linear, Space::Log, Space::Logit] {
        let all = Catches::from([Ascent, NoCorrection, SwappedDecays, NeighborGradient]);
        let all = if space == Space::Linear { all } else { all.and(&[WrongSpace, NoChainRule]) };
        add("the seventh step", space, 7, 4097, all, |r| 2.0 * r);
        add("the first step", space, 1, 65, [Ascent, NoCorrection].into(), |r| r);
        add("no gradient", space, 1, 64, [NeighborValue].into(), |_| 0.0);
        add("gradients of 1e-8", space, 1, 64, [Ascent, NoEpsilon].into(), |r| 1e-8 * r);
        add("gradients of 1e15", space, 3, 64, [Ascent, NoCorrection].into(), |r| 1e15 * r);
        let not_finite: fn(f32) -> f32 = |r| if r > 0.0 { f32::INFINITY } else { f32::NAN };
        add("gradients that are not finite", space, 2, 64, [Poisoned].into(), not_finite);
    }
    area
}
