//! Steps of the optimiser.

use crate::{
    gpu::{Recorder, Tensor},
    kernels::refine as kernels,
    ops::row_chunks,
};

/// The constants of Adam (Kingma and Ba 2015).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    /// Decay of the mean of gradients.
    pub beta1: f32,
    /// Decay of the mean of squared gradients.
    pub beta2: f32,
    /// The number that is added to the root of the latter.
    pub eps: f32,
}

impl Default for Adam {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, eps: 1e-8 }
    }
}

impl Adam {
    /// The numbers that [`record_adam`] reads in step `step`, counted from 1: the rate, the corrections of both moments, and 0.
    pub fn schedule(&self, rate: f32, step: u32) -> [f32; 4] {
        let correction = |beta: f32| (1.0 / (1.0 - f64::from(beta).powi(step as i32))) as f32;
        [rate, correction(self.beta1), correction(self.beta2), 0.0]
    }
}

/// The space in which Adam steps, in place of that of a stored value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Space {
    /// The value itself.
    Linear,
    /// The logarithm of a positive value, which stays within 1e-30..1e30.
    Log,
    /// ln(o / (1 - o)) of a value o in 0..1, which stays within 1e-6..1 - 1e-6.
    Logit,
}

/// Records one step of Adam: `parameters` `[len]` move against `gradient` `[len]`, d loss / d value as stored.
///
/// `moments` `[len]` each, of gradients in `space` and of their squares, are zero before the first step. `schedule` is
/// [`Adam::schedule`], written by the host before every step; `rate` multiplies the rate in it. A value whose gradient, or
/// the square of it, is not finite stays with its moments as it is.
#[allow(clippy::too_many_arguments)]
pub fn record_adam(
    rec: &mut Recorder,
    adam: Adam,
    parameters: Tensor,
    gradient: Tensor,
    moments: [Tensor; 2],
    schedule: Tensor,
    rate: f32,
    space: Space,
    len: usize,
) {
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
            space: space as u32,
        };
        rec.dispatch(kernel, part.len());
    }
}
