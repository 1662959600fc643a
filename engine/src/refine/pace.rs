//! Number of steps for a time, corrected by the measured speed.

use super::{growth::GROWTH_END, schedule::factor};
use std::time::{Duration, Instant};

/// Growth by a factor makes a step slower by this power of it.
const GROWTH_COST: f64 = 0.5;
/// Limits of one correction.
const CORRECTION: [f64; 2] = [0.5, 2.0];
const PARTS: usize = 64;

/// Expected cost of a run's steps. A step at full size before growth costs 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Work {
    pub coarse: bool,
    /// Shorter side of the photos in pixels.
    pub shortest: u32,
    /// Final number of Gaussians relative to the initial one.
    pub growth: f64,
}

impl Work {
    /// Integrates the cost of a step between two fractions of the run.
    pub fn between(&self, from: f64, to: f64) -> f64 {
        let step = |along: f64| {
            let growth = self.growth.powf(GROWTH_COST * (along / GROWTH_END).min(1.0));
            growth / f64::from(factor(self.coarse, along, self.shortest))
        };
        let part = (to - from) / PARTS as f64;
        (0..PARTS).map(|i| part * step(from + (i as f64 + 0.5) * part)).sum()
    }
}

/// Corrects the number of steps during a run.
#[derive(Debug)]
pub(super) struct Pace {
    time: Duration,
    begin: Instant,
    work: Work,
    /// Time and completed fraction of the run at the last correction.
    last: (Duration, f64),
}

impl Pace {
    pub fn new(time: Duration, work: Work) -> Self {
        Self { time, begin: Instant::now(), work, last: (Duration::ZERO, 0.0) }
    }

    /// Returns the number of steps that ends the run in time.
    pub fn correct(&mut self, done: usize, steps: usize) -> usize {
        self.correct_at(self.begin.elapsed(), done, steps)
    }

    fn correct_at(&mut self, now: Duration, done: usize, steps: usize) -> usize {
        let along = done as f64 / steps as f64;
        let spent = (now - self.last.0).as_secs_f64().max(1e-9);
        let speed = self.work.between(self.last.1, along) / spent;
        let possible = self.time.saturating_sub(now).as_secs_f64() * speed / self.work.between(along, 1.0);
        let correction = possible.clamp(CORRECTION[0], CORRECTION[1]);
        let steps = done + ((steps - done) as f64 * correction).round() as usize;
        self.last = (now, done as f64 / steps as f64);
        steps
    }
}

/// Evenly spaced snapshots of a run whose number of steps may change.
pub(super) struct Snapshots {
    count: usize,
    taken: usize,
}

impl Snapshots {
    /// A resumed run has snapshots of `done` steps.
    pub fn new(count: usize, done: usize, steps: usize) -> Self {
        Self { count, taken: done * count / steps.max(1) }
    }

    /// Returns true if the scene is the next snapshot.
    pub fn is_due(&mut self, done: usize, steps: usize) -> bool {
        let is_due = done * self.count / steps > self.taken;
        self.taken += usize::from(is_due);
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_snapshot_is_repeated_or_lost() {
        let taken = |first: usize, steps: fn(usize) -> usize| {
            let mut snapshots = Snapshots::new(4, first, steps(first));
            (first + 1..=100).filter(|done| snapshots.is_due(*done, steps(*done))).collect::<Vec<_>>()
        };
        assert_eq!(taken(0, |_| 100), [25, 50, 75, 100]);
        assert_eq!(taken(50, |_| 100), [75, 100]);
        // The run becomes longer after step 50, or shorter after step 30.
        assert_eq!(taken(0, |done| if done <= 50 { 80 } else { 100 }), [20, 40, 75, 100]);
        assert_eq!(taken(0, |done| if done <= 45 { 60 } else { 100 }), [15, 30, 45, 100]);
        assert_eq!(taken(0, |done| if done <= 30 { 400 } else { 100 }), [31, 50, 75, 100]);
        assert_eq!(taken(0, |done| if done <= 60 { 400 } else { 100 }), [61, 62, 75, 100]);
    }

    const WORK: Work = Work { coarse: true, shortest: 252, growth: 16.0 };

    #[test]
    fn growth_and_full_size_make_steps_slower() {
        let none = Work { coarse: false, growth: 1.0, ..WORK };
        assert!((none.between(0.0, 1.0) - 1.0).abs() < 1e-12 && (none.between(0.5, 0.75) - 0.25).abs() < 1e-12);
        assert!((Work { growth: 1.0, ..WORK }.between(0.0, 1.0) - 0.75).abs() < 1e-12);
        // Four times slower in the second half.
        assert!((WORK.between(0.5, 1.0) - 2.0).abs() < 1e-12);
        assert!((WORK.between(0.0, 0.5) + WORK.between(0.5, 1.0) - WORK.between(0.0, 1.0)).abs() < 1e-3);
    }

    #[test]
    fn runs_end_in_time_at_any_speed() {
        let time = Duration::from_secs(60);
        for (slower, growth) in [(1.0, 16.0), (3.0, 16.0), (0.2, 16.0), (2.0, 60.0), (1.0, 1.0)] {
            let truth = Work { growth, ..WORK };
            let mut pace = Pace::new(time, WORK);
            let (mut steps, mut done, mut now) = (200, 0, 0.0);
            let step = 60.0 * slower / (200.0 * WORK.between(0.0, 1.0));
            while done < steps {
                let along = done as f64 / steps as f64;
                now += step * truth.between(along, along + 1e-3) / 1e-3;
                done += 1;
                if done % 10 == 0 && done < steps {
                    steps = pace.correct_at(Duration::from_secs_f64(now), done, steps);
                }
            }
            assert!((now / 60.0 - 1.0).abs() < 0.1, "{slower}, {growth}: {now} s, {steps} steps");
        }
    }
}
