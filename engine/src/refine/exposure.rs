//! A color transform per photo, from the scene's colors.

use super::{
    Exposure, RefineOptions,
    adam::HostAdam,
    checkpoint::State,
    exposed::EXPOSURE_NUMBERS,
    gaussians::{ADAM, Gaussians},
    views::View,
};
use crate::{Result, types::ColorTransform};

/// Least steps before exposures are learned, else a tenth of all: the scene must resemble the
/// photos.
const MIN_WARM_UP: usize = 10;
/// Loss weight of half the squared distance from the identity.
const PRIOR: f64 = 0.02;
/// Limit of a photo's first brightness relative to the scene's, and of its inverse.
const MAX_GAIN: f64 = 4.0;
/// Part of the squared error that learned exposures must explain.
const EXPLAINED: f64 = 0.2;
const MAX_RATE: f64 = 0.1;

pub(super) fn first_step(steps: usize) -> usize {
    (steps / 10).max(MIN_WARM_UP)
}

/// Color factors that fit a picture to its photo.
struct Gains {
    factors: [f64; 3],
    /// Squared errors, without and with the factors.
    squares: [f64; 2],
}

impl Gains {
    fn new(gaussians: &mut Gaussians, view: &View) -> Result<Self> {
        let (drawn, _) = gaussians.draw(view)?;
        let mut sums = [[0.0; 3]; 3];
        for (i, (drawn, value)) in view.image.kept(&drawn).iter().zip(view.values()).enumerate() {
            let [drawn, value] = [drawn.clamp(0.0, 1.0), value].map(f64::from);
            let products = [drawn * drawn, drawn * value, value * value];
            sums[i % 3].iter_mut().zip(products).for_each(|(sum, product)| *sum += product);
        }
        let factor = |[dd, dt, _]: [f64; 3]| if dd > 0.0 { (dt / dd).clamp(1.0 / MAX_GAIN, MAX_GAIN) } else { 1.0 };
        let factors = sums.map(factor);
        let squares = |factors: [f64; 3]| {
            let square = |([dd, dt, tt], factor): ([f64; 3], f64)| tt - factor * (2.0 * dt - factor * dd);
            sums.into_iter().zip(factors).map(square).sum()
        };
        Ok(Self { factors, squares: [squares([1.0; 3]), squares(factors)] })
    }

    fn differ(all: &[Self]) -> bool {
        let [without, with] = [0, 1].map(|i| all.iter().map(|gains| gains.squares[i]).sum::<f64>());
        with < (1.0 - EXPLAINED) * without
    }
}

/// Transforms of all photos. Those of training photos are learned, with the identity as their mean:
/// else a common factor could be the scene's or theirs.
#[derive(Clone)]
pub(super) struct Exposures {
    /// Differences from the identity.
    changes: Vec<[f64; EXPOSURE_NUMBERS]>,
    /// Set from a photo's first use on.
    adams: Vec<Option<HostAdam<EXPOSURE_NUMBERS>>>,
    training: Vec<usize>,
    rate: f64,
}

impl Exposures {
    /// Begins to learn the exposures of `training` among `count` photos, if requested or if those
    /// of `views` differ.
    pub fn start(
        gaussians: &mut Gaussians,
        options: &RefineOptions,
        training: &[usize],
        views: &[View],
        count: usize,
    ) -> Result<Option<Self>> {
        if options.exposure == Exposure::Off {
            return Ok(None);
        }
        let gains = views.iter().map(|view| Gains::new(gaussians, view)).collect::<Result<Vec<_>>>()?;
        if options.exposure == Exposure::Auto && !Gains::differ(&gains) {
            return Ok(None);
        }
        gaussians.learn_exposures();
        let mut exposures = Self::new(options, training, count);
        views.iter().zip(&gains).for_each(|(view, gains)| exposures.set(view.photo, gains));
        Ok(Some(exposures))
    }

    fn new(options: &RefineOptions, training: &[usize], count: usize) -> Self {
        let steps_per_round = training.len() as f64 / options.views_per_step as f64;
        Self {
            changes: vec![[0.0; EXPOSURE_NUMBERS]; count],
            adams: vec![None; count],
            training: training.to_vec(),
            rate: (f64::from(options.learning_rates.exposure) * steps_per_round).min(MAX_RATE),
        }
    }

    pub fn state(
        state: &mut State<'_>,
        name: &str,
        exposures: &mut Option<Self>,
        options: &RefineOptions,
        training: &[usize],
        count: usize,
    ) -> Result<()> {
        let mut began = usize::from(exposures.is_some());
        state.count(&format!("{name}.began"), &mut began)?;
        if began == 0 {
            return Ok(());
        }
        let Self { changes, adams, .. } = exposures.get_or_insert_with(|| Self::new(options, training, count));
        state.fixed(name, changes)?;
        state.adams(&format!("{name}.adam"), adams)
    }

    fn set(&mut self, photo: usize, gains: &Gains) {
        self.adams[photo] = Some(HostAdam::default());
        (0..3).for_each(|color| self.changes[photo][5 * color] = gains.factors[color] - 1.0);
    }

    pub fn expose(&mut self, gaussians: &mut Gaussians, views: &mut [View]) -> Result<()> {
        for view in views {
            if self.adams[view.photo].is_none() {
                self.set(view.photo, &Gains::new(gaussians, view)?);
            }
            view.exposure = self.get(view.photo);
        }
        Ok(())
    }

    pub fn get(&self, photo: usize) -> ColorTransform {
        let mut transform = ColorTransform::IDENTITY;
        let numbers = transform.0.as_flattened_mut().iter_mut();
        numbers.zip(self.changes[photo]).for_each(|(number, change)| *number += change as f32);
        transform
    }

    pub fn step(&mut self, photo: usize, gradient: [f32; EXPOSURE_NUMBERS], rate: f32) {
        let (Some(adam), changes) = (&mut self.adams[photo], &mut self.changes[photo]) else { return };
        let (gradient, rate) =
            (std::array::from_fn(|i| f64::from(gradient[i]) + PRIOR * changes[i]), self.rate * f64::from(rate));
        let moved = adam.step(ADAM, gradient, |_| rate);
        changes.iter_mut().zip(moved).for_each(|(change, moved)| *change += moved);
    }

    /// Moves the training photos' mean to the identity, once all are used.
    pub fn center(&mut self) {
        if !self.training.iter().all(|photo| self.adams[*photo].is_some()) {
            return;
        }
        let count = self.training.len() as f64;
        for i in 0..EXPOSURE_NUMBERS {
            let mean = self.training.iter().map(|photo| self.changes[*photo][i]).sum::<f64>() / count;
            self.training.iter().for_each(|photo| self.changes[*photo][i] -= mean);
        }
    }
}
