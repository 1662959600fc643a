use crate::{
    gpu::{Recorder, Tensor},
    kernels::refine as kernels,
    ops::row_chunks,
};

/// Constants of Adam (Kingma and Ba 2015).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Constant added to the root of the second moment.
    pub eps: f32,
}

impl Default for Adam {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, eps: 1e-8 }
    }
}

impl Adam {
    /// Input of [`record_adam`] for step `step`, from 1: rate, bias corrections of both moments, 0.
    pub fn schedule(&self, rate: f32, step: u32) -> [f32; 4] {
        let correction = |beta: f32| (1.0 / (1.0 - f64::from(beta).powi(step as i32))) as f32;
        [rate, correction(self.beta1), correction(self.beta2), 0.0]
    }
}

/// Host Adam for a photo's numbers.
#[derive(Clone, Copy, Debug)]
pub(super) struct HostAdam<const N: usize> {
    pub first: [f64; N],
    pub second: [f64; N],
    pub steps: i32,
}

impl<const N: usize> Default for HostAdam<N> {
    fn default() -> Self {
        Self { first: [0.0; N], second: [0.0; N], steps: 0 }
    }
}

impl<const N: usize> HostAdam<N> {
    /// Returns the change, with the rate of each number: none for a non-finite gradient.
    pub fn step(&mut self, adam: Adam, gradient: [f64; N], rate: impl Fn(usize) -> f64) -> [f64; N] {
        if !gradient.iter().all(|g| g.is_finite()) {
            return [0.0; N];
        }
        self.steps += 1;
        let [beta1, beta2, eps] = [adam.beta1, adam.beta2, adam.eps].map(f64::from);
        std::array::from_fn(|i| {
            self.first[i] = beta1 * self.first[i] + (1.0 - beta1) * gradient[i];
            self.second[i] = beta2 * self.second[i] + (1.0 - beta2) * gradient[i].powi(2);
            let mean = self.first[i] / (1.0 - beta1.powi(self.steps));
            let square = self.second[i] / (1.0 - beta2.powi(self.steps));
            -rate(i) * mean / (square.sqrt() + eps)
        })
    }
}

/// Space of Adam's steps for a stored value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Space {
    /// The value itself.
    Linear,
    /// Logarithm of a positive value, clamped to 1e-30..1e30.
    Log,
    /// Logit ln(o / (1 - o)) of a value o in 0..1, clamped to 1e-6..1 - 1e-6.
    Logit,
}

/// Rate of a tensor of rows, such as SH coefficients by Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// Rate of the first three values of a row.
    pub first: f32,
    /// Rate of the other values.
    pub others: f32,
    /// Values of a row, at least 1.
    pub width: u32,
}

impl From<f32> for Rate {
    fn from(rate: f32) -> Self {
        Self { first: rate, others: rate, width: 1 }
    }
}

/// Records one step of Adam on `parameters` `[len]` against `gradient` `[len]`, d loss / d stored
/// value.
///
/// `moments`, `[len]` each, are in `space` and zero before the first step. The host writes
/// [`Adam::schedule`] to `schedule` before every step; `rate` scales its rate. Non-finite gradients
/// or squares change nothing.
#[allow(clippy::too_many_arguments)]
pub fn record_adam(
    rec: &mut Recorder,
    adam: Adam,
    parameters: Tensor,
    gradient: Tensor,
    moments: [Tensor; 2],
    schedule: Tensor,
    rate: impl Into<Rate>,
    space: Space,
    len: usize,
) {
    let Rate { first: rate, others, width } = rate.into();
    for part in row_chunks(rec, len, &[size_of::<f32>()]) {
        let [parameters, gradient, first, second] =
            [parameters, gradient, moments[0], moments[1]].map(|t| t.slice::<f32>(part.start, part.len()));
        let kernel = kernels::Adam {
            parameters,
            gradient,
            first,
            second,
            schedule,
            count: part.len() as u32,
            beta1: adam.beta1,
            beta2: adam.beta2,
            eps: adam.eps,
            rate,
            others,
            width,
            phase: (part.start % width as usize) as u32,
            space: space as u32,
        };
        rec.dispatch(kernel, part.len());
    }
}
