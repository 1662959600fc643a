//! Gradient of GELU.

use crate::{
    Area, Case, Mode, Worst,
    bound::{TINY, U, exponential, gamma, half},
    case,
    noise::Noise,
    trial::Trial,
};
use zipsplat::{Result, gpu::Device, kernels::ops::Gelu};
use zipsplat_reference::ops::gelu::gelu_backward;

const REASON: &str = "erf is a fit to 1.2e-7, and the density's exp is allowed 3 + 2|x| units; both are multiplied by the gradient \
    with a few roundings more";

struct Slopes(Vec<f32>, Vec<f32>);

#[derive(Clone, Copy, Debug)]
enum Fault {
    Zero,
    HalfResult,
    /// GELU's derivative without x times the density.
    NoDensity,
    /// Derivative of x sigmoid(1.702 x).
    SigmoidGelu,
}

impl case::Problem for Slopes {
    type Output = Vec<f32>;
    type Truth = Vec<f64>;
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let (mut trial, count) = (Trial::new(device), self.0.len());
        let (source, gradient, out) = (trial.input(&self.0), trial.input(&self.1), trial.output::<f32>(count));
        trial.rec.dispatch(Gelu { source, gradient, out, count: count as u32, backward: true }, count);
        trial.result(out)
    }

    fn truth(&self, _: Mode) -> Vec<f64> {
        self.0.iter().zip(&self.1).map(|(&x, &g)| gelu_backward(x.into(), g.into())).collect()
    }

    fn judge(&self, truth: &Vec<f64>, output: &Vec<f32>, _: Mode) -> Worst {
        Worst::of(output, truth, |i| {
            let (x, g) = (f64::from(self.0[i]), f64::from(self.1[i]).abs());
            let density = (-x * x / 2.0).exp() * 0.4;
            let of_density = x.abs() * density * (exponential(x * x / 2.0) + x * x * U + gamma(6));
            // Includes the rounded argument of erf, whose slope is twice the density.
            let of_erf = 1.2e-7 + density * (exponential(x * x / 2.0) + x.abs() * gamma(3)) + gamma(3);
            g * (of_density + of_erf + gamma(3)) + TINY
        })
    }

    fn faulty(&self, truth: &Vec<f64>, fault: Fault, _: Mode) -> Vec<Vec<f32>> {
        let one = |i: usize| {
            let (x, g) = (f64::from(self.0[i]), f64::from(self.1[i]));
            let sigmoid = 1.0 / (1.0 + (-1.702 * x).exp());
            match fault {
                Fault::Zero => 0.0,
                Fault::HalfResult => half(truth[i]),
                Fault::NoDensity => truth[i] - g * x * 0.3989422804 * (-x * x / 2.0).exp(),
                Fault::SigmoidGelu => g * sigmoid * (1.0 + 1.702 * x * (1.0 - sigmoid)),
            }
        };
        vec![(0..truth.len()).map(|i| one(i) as f32).collect()]
    }
}

pub fn area() -> Area {
    use Fault::*;
    let every = || {
        let source: Vec<f32> = (-2000..=2000).map(|i| i as f32 / 200.0).collect();
        let gradient = Noise(5).values(source.len());
        Slopes(source, gradient)
    };
    let far = || Slopes([-1e30, -1e5, -20.0, 20.0, 1e5, 1e30].into(), [1.0, -2.0, 3.0, 1.0, -2.0, 3.3].into());
    let cases = vec![
        Case::new("every value from -10 to 10", 4001, [Zero, HalfResult, NoDensity, SigmoidGelu], every),
        Case::new("far from zero", 6, [Zero, HalfResult], far),
    ];
    Area { kernel: "ops/gelu", size: "values", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
