//! Defaults by length: number of Gaussians, steps, size of the photos.

use super::{Photos, RefineOptions, views::fitted};
use crate::{Error, Result};
use std::{iter::successors, time::Duration};

/// Fewest steps with growth or, without it, cleared floaters.
pub(super) const GROWTH_FROM: usize = 50;
/// Largest fraction of hidden Gaussians, and the uses of a photo between which it rises from 0.
const DROPOUT: f64 = 0.1;
const DROPOUT_USES: [f64; 2] = [100.0, 300.0];
/// Limits of growth by default: pixels of all photos per Gaussian, and its factor.
pub(super) const PIXELS_PER_GAUSSIAN: f64 = 32.0;
const MOST_GROWTH: f64 = 16.0;
/// Steps between which the limit grows with their square root: fewer Gaussians would stop gaining
/// detail.
pub(super) const DETAIL: [usize; 2] = [200, 800];
/// Fewer steps in a time halve the photos' size, down to a shorter side of `SHORTEST` pixels.
const ENOUGH_STEPS: u32 = 150;
const SHORTEST: u32 = 240;

/// Fraction of the Gaussians that a step hides.
pub(super) fn dropout(options: &RefineOptions, steps: f64, training: usize) -> f64 {
    let uses = steps * options.views_per_step as f64 / training as f64;
    let [first, last] = DROPOUT_USES;
    DROPOUT * ((uses - first) / (last - first)).clamp(0.0, 1.0)
}

/// Number of Gaussians that a scene of `len` grows to, if any.
pub(super) fn grown_len(
    options: &RefineOptions,
    steps: usize,
    len: usize,
    sizes: impl Iterator<Item = [u32; 2]>,
) -> Option<usize> {
    let default = || {
        let pixels: f64 = sizes.map(|[width, height]| f64::from(width) * f64::from(height)).sum();
        let most = (pixels / PIXELS_PER_GAUSSIAN).min(MOST_GROWTH * len as f64);
        (steps >= GROWTH_FROM).then_some((detail(steps) * most) as usize)
    };
    options.max_gaussians.or_else(default).filter(|most| *most > len)
}

fn detail(steps: usize) -> f64 {
    (steps.clamp(DETAIL[0], DETAIL[1]) as f64 / DETAIL[0] as f64).sqrt()
}

pub(super) fn sizes(photos: &dyn Photos, most: Option<[u32; 2]>, factor: u32) -> impl Iterator<Item = [u32; 2]> {
    (0..photos.count()).map(move |i| fitted(photos.size(i), most, factor))
}

/// Returns the most steps, at least 1, within `most` work.
pub(super) fn steps_in_time(most: f64, work: impl Fn(usize) -> f64) -> usize {
    // No step is expected to take less than a quarter of one at full size.
    let (mut fits, mut too_many) = (1, (4.0 * most) as usize + 2);
    while too_many > fits + 1 {
        let middle = fits.midpoint(too_many);
        let end = if work(middle) <= most { &mut fits } else { &mut too_many };
        *end = middle;
    }
    fits
}

/// Returns the largest photo size, `most` or halved, that allows enough steps in `time`, and the
/// time of a step.
pub(super) fn size_in_time(
    photos: &dyn Photos,
    most: Option<[u32; 2]>,
    time: Duration,
    time_step: impl Fn(Option<[u32; 2]>) -> Result<Duration>,
) -> Result<(Option<[u32; 2]>, Duration)> {
    let halves: Vec<_> = successors(Some(most), |most| half_size(photos, *most).map(Some)).collect();
    // The smallest first: a step with the largest may take all the time.
    let mut rising = halves.into_iter().rev();
    let mut size = rising.next().unwrap_or(most);
    let mut step = time_step(size)?;
    let enough = |step: Duration| step * ENOUGH_STEPS <= time;
    for larger in rising {
        // Twice the size takes at least twice as long.
        if !enough(2 * step) {
            break;
        }
        match time_step(larger) {
            Ok(longer) if enough(longer) => (size, step) = (larger, longer),
            Ok(_) | Err(Error::Memory { .. }) => break,
            Err(error) => return Err(error),
        }
    }
    Ok((size, step))
}

/// Halves photos of both orientations, unless the largest becomes too small.
fn half_size(photos: &dyn Photos, most: Option<[u32; 2]>) -> Option<[u32; 2]> {
    let largest = sizes(photos, most, 2).max_by_key(|[width, height]| u64::from(*width) * u64::from(*height))?;
    let limit = sizes(photos, most, 2).reduce(|a, b| [a[0].max(b[0]), a[1].max(b[1])]);
    limit.filter(|_| largest.iter().all(|side| *side >= SHORTEST))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Image;

    #[test]
    fn growth_leaves_time_for_fewer_steps() {
        let work = |steps: usize| if steps < GROWTH_FROM { steps as f64 } else { 1.5 * steps as f64 };
        for (most, steps) in [(0.1, 1), (49.9, 49), (60.0, 49), (75.0, 50), (900.0, 600)] {
            assert_eq!(steps_in_time(most, work), steps, "{most}");
        }
        assert_eq!(steps_in_time(100.0, |steps| steps as f64 / 4.0), 400);
    }

    #[test]
    fn photos_are_as_large_as_enough_steps_allow() {
        let photos = [Image::new(1600, 1000, vec![0; 3 * 1600 * 1000]).expect("a photo")];
        let chosen = |seconds: u64| {
            let timed = std::cell::Cell::new(0);
            // A millisecond a thousand pixels.
            let time_step = |most: Option<[u32; 2]>| {
                timed.set(timed.get() + 1);
                let [width, height] = fitted([1600, 1000], most, 1).map(u64::from);
                Ok(Duration::from_micros(width * height))
            };
            let size = size_in_time(&photos, Some([2000, 1600]), Duration::from_secs(seconds), time_step);
            (size.expect("a size").0.expect("a limit"), timed.get())
        };
        assert_eq!(chosen(1), ([400, 250], 1));
        // 150 steps at 800 x 500 take 60 s.
        assert_eq!(chosen(59), ([400, 250], 2));
        assert_eq!(chosen(61), ([800, 500], 2));
        assert_eq!(chosen(1000), ([2000, 1600], 3));
    }

    #[test]
    fn photos_of_both_orientations_are_halved_alike() {
        let [wide, tall] = [[1600, 1000], [1000, 1600]];
        let photos = [wide, tall].map(|[w, h]| Image::new(w, h, vec![0; 3 * 1600 * 1000]).expect("a photo"));
        let half = half_size(&photos, None);
        assert_eq!([wide, tall].map(|size| fitted(size, half, 1)), [[800, 500], [500, 800]]);
        assert_eq!(half_size(&photos, half), Some([400, 400]));
        assert_eq!(half_size(&photos, Some([400, 400])), None);
    }

    #[test]
    fn many_uses_of_photos_hide_gaussians() {
        let hidden = |steps: f64| dropout(&RefineOptions::default(), steps, 16);
        assert_eq!([0.0, 400.0, 800.0, 1200.0, f64::INFINITY].map(hidden), [0.0, 0.0, 0.05, 0.1, 0.1]);
    }

    #[test]
    fn more_steps_allow_more_gaussians() {
        let grown =
            |steps: usize, len: usize| grown_len(&RefineOptions::default(), steps, len, [[320, 100]; 2].into_iter());
        assert_eq!(
            [49, 50, 200, 450, 800, 9999].map(|steps| grown(steps, 500)),
            [None, Some(2000), Some(2000), Some(3000), Some(4000), Some(4000)]
        );
        assert_eq!([200, 800].map(|steps| grown(steps, 10)), [Some(160), Some(320)]);
        assert_eq!([200, 800].map(|steps| grown(steps, 2000)), [None, Some(4000)]);
    }
}
