use crate::{ops::linear::gelu_error, prelude::*};
use zipsplat::kernels::ops::Gelu;
use zipsplat_reference::ops::{activation::gelu, gelu::gelu_backward};

const REASON: &str = "erf is a fit to 1.2e-7, and the density's exp is allowed 3 + 2|x| units; both are multiplied by the gradient \
    with a few roundings more";

/// Without gradients, GELU itself.
struct Problem {
    source: Vec<f32>,
    gradient: Option<Vec<f32>>,
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    HalfResult,
    NoDensity,
    /// Derivative of x sigmoid(1.702 x).
    SigmoidGelu,
}

impl Problem {
    fn gradient(&self, i: usize) -> f64 {
        self.gradient.as_ref().map_or(1.0, |gradient| f64::from(gradient[i]))
    }

    fn bound(&self, i: usize) -> f64 {
        let x = f64::from(self.source[i]);
        if self.gradient.is_none() {
            return gelu_error(x, 0.0);
        }
        let density = (-x * x / 2.0).exp() * 0.4;
        let of_density = x.abs() * density * (exponential(x * x / 2.0) + x * x * U + gamma(6));
        // Includes the rounded argument of erf, whose slope is twice the density.
        let of_erf = 1.2e-7 + density * (exponential(x * x / 2.0) + x.abs() * gamma(3)) + gamma(3);
        self.gradient(i).abs() * (of_density + of_erf + gamma(3)) + TINY
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let (mut trial, count) = (Trial::new(device), self.source.len());
        let (source, out) = (trial.input(&self.source), trial.output::<f32>(count));
        let gradient = self.gradient.as_ref().map_or(source, |gradient| trial.input(gradient));
        let backward = self.gradient.is_some();
        trial.rec.dispatch(Gelu { source, gradient, out, count: count as u32, backward, silu: false }, count);
        trial.result(out)
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let value = if self.gradient.is_some() { gelu_backward } else { |x, _| gelu(x) };
        let truth = (0..self.source.len()).map(|i| value(self.source[i].into(), self.gradient(i)));
        [truth.collect(), (0..self.source.len()).map(|i| self.bound(i)).collect()]
    }

    fn typical(&self, _: Mode) -> Tolerance {
        Tolerance::ELEMENTWISE
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let one = |(i, &truth): (usize, &f64)| {
            let (x, g) = (f64::from(self.source[i]), self.gradient(i));
            let sigmoid = 1.0 / (1.0 + (-1.702 * x).exp());
            match fault {
                Fault::HalfResult => half(truth),
                Fault::NoDensity => truth - g * x * 0.3989422804 * (-x * x / 2.0).exp(),
                Fault::SigmoidGelu => g * sigmoid * (1.0 + 1.702 * x * (1.0 - sigmoid)),
            }
        };
        truth.iter().enumerate().map(one).collect()
    }
}

pub fn shapes() -> Area {
    let make = |backward: bool| {
        let of = move |count| {
            let source = Noise::new(1).values(count).iter().map(|x| 8.0 * x).collect();
            Problem { source, gradient: backward.then(|| Noise::new(2).values(count)) }
        };
        move || [0, 63, 65, 1001].map(of).into()
    };
    let mut area = Area { cases: Vec::new(), ..area() };
    area.sweep("GELU of +-8", 1001, [Fault::HalfResult], make(false));
    area.sweep("its gradient of +-8", 1001, [Fault::HalfResult], make(true));
    area
}

pub fn area() -> Area {
    use Fault::*;
    let every = || {
        let source: Vec<f32> = (-2000..=2000).map(|i| i as f32 / 200.0).collect();
        let gradient = Noise::new(5).values(source.len());
        Problem { source, gradient: Some(gradient) }
    };
    let far = || Problem {
        source: [-1e30, -1e5, -20.0, 20.0, 1e5, 1e30].into(),
        gradient: Some([1.0, -2.0, 3.0, 1.0, -2.0, 3.3].into()),
    };
    let mut area = Area::new("ops/gelu", "values", Mode::ONLY_EXACT, REASON);
    area.add("every value from -10 to 10", 4001, [HalfResult, NoDensity, SigmoidGelu], every);
    area.add("far from zero", 6, [HalfResult], far);
    area
}
