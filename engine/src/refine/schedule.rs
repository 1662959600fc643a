use std::f64::consts::PI;

const LAST: f64 = 0.1;
/// Most steps at full rates.
const FULL: f64 = 100.0;
/// Training PSNR in dB above which a scene's rate shrinks with its error.
const GOOD: f64 = 20.0;
/// Ends of the coarse phases, as fractions of the steps, and their downscaling factors.
const COARSE: [(f64, u32); 2] = [(0.2, 4), (0.5, 2)];
/// Fraction of the depth loss's weight in the last step.
const LAST_DEPTH: f64 = 0.01;
/// Least shorter side of a downscaled photo, in pixels.
const SHORTEST: u32 = 96;

/// Cosine decay of the rate to a tenth, and coarse-to-fine photo sizes. Beyond `FULL` steps the
/// first rate is inversely proportional to the steps, to bound the drift of barely constrained
/// Gaussians.
#[derive(Clone, Copy, Debug)]
pub(super) struct Schedule {
    pub steps: usize,
    pub coarse: bool,
}

impl Schedule {
    pub fn rate(&self, step: usize) -> f32 {
        let along = step as f64 / (self.steps.max(2) - 1) as f64;
        let first = (FULL / self.steps as f64).min(1.0);
        (first * (LAST + (1.0 - LAST) * 0.5 * (1.0 + (PI * along).cos()))) as f32
    }

    /// Fraction of the initial weight.
    pub fn depth_weight(&self, step: usize) -> f32 {
        LAST_DEPTH.powf(step as f64 / (self.steps.max(2) - 1) as f64) as f32
    }

    pub fn factor(&self, step: usize, shortest: u32) -> u32 {
        factor(self.coarse, step as f64 / self.steps as f64, shortest)
    }
}

/// Downscaling factor for this shorter side, `along` the run.
pub(super) fn factor(coarse: bool, along: f64, shortest: u32) -> u32 {
    phases(coarse, shortest).find(|(end, _)| along < *end).map_or(1, |(_, factor)| factor)
}

/// Ends of the phases as fractions of the steps, and downscaling factors.
pub(super) fn phases(coarse: bool, shortest: u32) -> impl Iterator<Item = (f64, u32)> {
    let fits = move |(_, factor): &(f64, u32)| coarse && shortest >= factor * SHORTEST;
    COARSE.into_iter().filter(fits).chain([(1.0, 1)])
}

/// Fraction of the rates for this training PSNR: the error relative to that at 20 dB, at most 1.
/// Adam's steps have full length at any gradient, which would harm a good scene.
pub(super) fn rate_of_error(psnr: f64) -> f32 {
    10f64.powf((GOOD - psnr) / 20.0).min(1.0) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_fall_to_a_tenth_and_photos_grow() {
        let schedule = Schedule { steps: 100, coarse: true };
        let rates: Vec<f32> = (0..100).map(|step| schedule.rate(step)).collect();
        assert!(rates[0] == 1.0 && (rates[99] - 0.1).abs() < 1e-6 && rates.is_sorted_by(|a, b| a > b));
        assert_eq!([0, 19, 20, 49, 50, 99].map(|step| schedule.factor(step, 400)), [4, 4, 2, 2, 1, 1]);
        assert_eq!([0, 20, 50].map(|step| schedule.factor(step, 252)), [2, 2, 1]);
        assert_eq!(schedule.factor(0, 84), 1);
        assert_eq!(Schedule { coarse: false, ..schedule }.factor(0, 400), 1);
        assert_eq!(Schedule { steps: 1, ..schedule }.rate(0), 1.0);
        assert_eq!(Schedule { steps: 400, ..schedule }.rate(0), 0.25);
        let weights = [0, 99].map(|step| schedule.depth_weight(step));
        assert!(weights[0] == 1.0 && (weights[1] - 0.01).abs() < 1e-6);
        assert_eq!([12.0, 20.0, 40.0].map(rate_of_error), [1.0, 1.0, 0.1]);
    }
}
