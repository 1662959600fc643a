mod measure;
mod state;

pub(super) use state::Saving;

use super::{
    RefineOptions, RefineProgress, RefineResult, StopReason,
    cameras::Cameras,
    checkpoint::State,
    exposure::{Exposures, first_step},
    free_space::FreeSpace,
    gaussians::Gaussians,
    growth::{Growth, drop_invisible},
    length::GROWTH_FROM,
    pace::{Pace, Snapshots},
    photos::PhotoCache,
    planned::PhotoLoss,
    schedule::{Schedule, rate_of_error},
    views::{Order, View, split, unmasked},
};
use crate::{
    Error, Result,
    types::{Camera, ColorTransform, Scene},
};
use std::{collections::VecDeque, ops::ControlFlow, time::Instant};

/// Evaluations of held-out photos or, without any, of the loss; relocations while growing.
const EVALUATIONS: usize = 20;
const MAX_MEASURED: usize = 16;
/// Tolerated loss of held-out PSNR in dB by a later step: few photos are a noisy measure.
const SLACK: f64 = 0.5;
/// Divergence limits without and with dropout: mean loss over its minimum. Growth may double it.
const DIVERGED: [f32; 2] = [4.0, 16.0];

pub(super) struct Refinement<'a> {
    pub photos: PhotoCache<'a>,
    cameras: Cameras,
    exposures: Option<Exposures>,
    options: RefineOptions,
    schedule: Schedule,
    /// Corrects the number of steps, if a time was given.
    pub pace: Option<Pace>,
    gaussians: Gaussians,
    growth: Option<Growth>,
    free_space: Option<FreeSpace>,
    order: Order,
    training: Vec<usize>,
    upcoming: VecDeque<usize>,
    /// Downscaling factor.
    factor: u32,
    measured: Vec<View>,
    validation: Vec<View>,
    holdout: Vec<usize>,
    sizes: Vec<(usize, [u32; 2])>,
    losses: Vec<f32>,
    holdout_psnr: Vec<(usize, f64)>,
    evaluated: Option<usize>,
    /// Steps between evaluations, and the first with exposures, by the planned number of steps.
    interval: usize,
    first_exposed: usize,
    /// First step at the current size, and the least mean loss since then.
    began: usize,
    least: f32,
    latest: f32,
    fraction: f32,
    /// Initial weight of the depth loss, times the scene's distance.
    depth_weight: f32,
    kept: Kept,
    /// Next checkpoint, unless its loss is worse.
    next: Option<Kept>,
}

#[derive(Clone)]
struct Kept {
    step: usize,
    scene: Scene,
    cameras: Vec<Camera>,
    exposures: Option<Exposures>,
}

impl<'a> Refinement<'a> {
    pub fn new(
        mut gaussians: Gaussians,
        mut scene: Scene,
        scene_distance: f64,
        mut photos: PhotoCache<'a>,
        cameras: &[Camera],
        options: RefineOptions,
        steps: usize,
    ) -> Result<Self> {
        for (i, camera) in cameras.iter().enumerate() {
            photos.camera(i, camera, 1)?;
        }
        let (training, holdout) = split(cameras.len(), options.holdout_views.unwrap_or(0));
        let measured: Vec<usize> = training.iter().step_by(training.len().div_ceil(MAX_MEASURED)).copied().collect();
        let [measured, validation] = [&measured, &holdout].map(|chosen| photos.views(cameras, chosen, &[], 1));
        let [measured, validation] = [measured?, validation?].map(unmasked);
        // The first camera fixes the world.
        let moving = if options.optimize_cameras { &training[1..] } else { &[] };
        let rates = [
            f64::from(options.learning_rates.camera_rotation),
            scene_distance * f64::from(options.learning_rates.camera_translation),
        ];
        let growth = options.max_gaussians.map(|most| Growth::new(scene.len(), most, options.seed));
        let depth_weight = options.depth_loss.map_or(0.0, |loss| scene_distance * f64::from(loss.weight));
        scene.antialiased = options.antialiased.unwrap_or(scene.antialiased);
        gaussians.draw_as(&scene);
        Ok(Self {
            photos,
            cameras: Cameras::new(cameras, moving, rates),
            schedule: Schedule { steps, coarse: options.coarse_to_fine },
            order: Order::new(training.len(), options.seed),
            options,
            pace: None,
            gaussians,
            growth,
            free_space: None,
            training,
            upcoming: VecDeque::new(),
            factor: 0,
            measured,
            validation,
            holdout,
            fraction: 1.0,
            depth_weight: depth_weight as f32,
            kept: Kept { step: 0, scene, cameras: cameras.to_vec(), exposures: None },
            exposures: None,
            sizes: Vec::new(),
            losses: Vec::new(),
            holdout_psnr: Vec::new(),
            evaluated: None,
            interval: steps.div_ceil(EVALUATIONS).max(1),
            first_exposed: first_step(steps),
            began: 0,
            least: f32::INFINITY,
            latest: 0.0,
            next: None,
        })
    }

    pub fn finish(
        mut self,
        progress: &mut dyn FnMut(RefineProgress<'_>) -> ControlFlow<()>,
        begin: Instant,
        saving: Option<&mut Saving>,
        loaded: Option<State<'_>>,
    ) -> Result<RefineResult> {
        let begin = saving.as_ref().and_then(|saving| begin.checked_sub(saving.spent())).unwrap_or(begin);
        let before = self.training_psnr()?;
        self.fraction = rate_of_error(before);
        // Held-out photos select the best step, and LPIPS trades PSNR for detail. Otherwise the
        // given scene is a candidate.
        let given = (self.holdout.is_empty() && self.options.perceptual_loss.is_none()).then(|| self.kept.clone());
        let clears = self.schedule.steps >= GROWTH_FROM && self.gaussians.tokens.is_none();
        self.find_free_space(self.growth.is_some() || clears);
        let resumed_step = match loaded {
            Some(mut state) => self.load(&mut state)?,
            None => 0,
        };
        let stop_reason = self.run(progress, begin, resumed_step, saving)?;
        let profile = self.options.profile.then(|| self.profile()).transpose()?.flatten();
        let peak_bytes = self.gaussians.device().allocated_bytes();
        let photo_bytes = self.options.max_photo_bytes - self.photos.left;
        self.gaussians.show(&self.kept.scene)?;
        let mut after = self.training_psnr()?;
        if let Some(given) = given
            && (after.is_nan() || after < before)
        {
            (self.kept, after) = (given, before);
        }
        let masks = self.measured.iter().filter_map(|view| view.image.mask.as_ref());
        let ignored = masks.flatten().filter(|kept| **kept == 0).count();
        let pixels: usize = self.measured.iter().map(|view| view.image.rgb.len() / 3).sum();
        let targets = self.measured.iter().filter_map(|view| view.depth.as_ref());
        let known = targets.flat_map(|depth| depth.iter()).filter(|target| **target > 0.0).count();
        let Self { losses, kept, holdout_psnr, holdout, sizes, schedule, .. } = self;
        let Kept { step: best_step, scene, cameras, exposures } = kept;
        Ok(RefineResult {
            scene,
            exposures: exposures.map(|all| (0..cameras.len()).map(|photo| all.get(photo)).collect()),
            cameras,
            resumed_step,
            steps: schedule.steps,
            losses,
            best_step,
            holdout_psnr,
            training_psnr: [after, before],
            masked_fraction: ignored as f64 / pixels.max(1) as f64,
            depth_fraction: known as f64 / pixels.max(1) as f64,
            holdout_views: holdout,
            sizes,
            took: begin.elapsed(),
            peak_bytes,
            photo_bytes,
            stop_reason,
            profile,
        })
    }

    fn run(
        &mut self,
        progress: &mut dyn FnMut(RefineProgress<'_>) -> ControlFlow<()>,
        begin: Instant,
        first: usize,
        mut saving: Option<&mut Saving>,
    ) -> Result<Option<StopReason>> {
        let mut steps = self.schedule.steps;
        if first == 0 {
            self.evaluate(0)?;
        }
        self.photos.fill(&self.training)?;
        if first < steps {
            self.reserve()?;
        }
        let (mut snapshots, mut step) = (Snapshots::new(self.options.snapshots, first, steps), first);
        while step < steps {
            self.resize(step);
            if step == self.first_exposed {
                let (training, views, count) = (&self.training, &self.measured, self.cameras.all().len());
                self.exposures = Exposures::start(&mut self.gaussians, &self.options, training, views, count)?;
            }
            let mut views = match self.next_views() {
                Ok(views) => views,
                Err(error) if step > 0 => return self.interrupt(error, step, saving, begin),
                Err(error) => return Err(error),
            };
            if let Some(exposures) = &mut self.exposures {
                exposures.expose(&mut self.gaussians, &mut views)?;
            }
            let weights =
                [self.fraction * self.schedule.rate(step), self.depth_weight * self.schedule.depth_weight(step)];
            let found = match self.gaussians.step(&views.iter().collect::<Vec<_>>(), weights) {
                // The Gaussians are those before the step, which may be taken later.
                Err(error @ Error::Memory { .. }) if step > 0 => {
                    views.iter().rev().for_each(|view| self.upcoming.push_front(view.photo));
                    return self.interrupt(error, step, saving, begin);
                }
                found => found?,
            };
            let loss = found.iter().map(|found| found.loss).sum::<f32>() / found.len() as f32;
            self.losses.push(loss);
            self.step_photos(step, &found);
            let done = step + 1;
            if !loss.is_finite() {
                return Ok(Some(StopReason::Diverged(format!("the loss of step {done} is {loss}"))));
            }
            let (evaluates, along) = (done.is_multiple_of(self.interval), done as f64 / steps as f64);
            if evaluates || done == steps {
                if let Some(why) = self.check_loss() {
                    return Ok(Some(StopReason::Diverged(why)));
                }
                self.evaluate(done)?;
            }
            if evaluates && Growth::is_due(along) {
                self.clear_and_grow(along, weights[0])?;
            }
            if let Some(pace) = self.pace.as_mut().filter(|_| evaluates && done < steps) {
                steps = pace.correct(done, steps);
                self.schedule.steps = steps;
                saving.iter_mut().for_each(|saving| saving.plan(steps, &self.options));
            }
            let eta = begin.elapsed().mul_f64((steps - done) as f64 / done as f64);
            let psnr = self.holdout_psnr.last().map(|(_, psnr)| *psnr);
            let scene = snapshots.is_due(done, steps).then(|| self.scene()).transpose()?;
            let now = RefineProgress { step: done, steps, loss, psnr, eta, scene: scene.as_ref() };
            let cancelled = progress(now).is_break();
            if let Some(saving) = saving.as_mut().filter(|saving| cancelled || saving.is_due())
                && let Err(error) = self.save(saving, done, begin)
            {
                return self.stop(done, StopReason::Failed(error.to_string()));
            }
            if cancelled {
                return self.stop(done, StopReason::Cancelled);
            }
            step = done;
        }
        self.keep();
        Ok(None)
    }

    /// By the given scene, which is kept first.
    fn find_free_space(&mut self, clears: bool) {
        let Self { kept: Kept { scene, cameras, .. }, training, .. } = self;
        let training = || training.iter().map(|i| cameras[*i]).collect::<Vec<_>>();
        self.free_space = clears.then(|| FreeSpace::new(scene, &training()));
    }

    fn clear_and_grow(&mut self, along: f64, rate: f32) -> Result<()> {
        let Self { growth, free_space: Some(free_space), .. } = self else { return Ok(()) };
        let cameras: Vec<Camera> = self.training.iter().map(|i| self.cameras.all()[*i]).collect();
        self.gaussians.edit(|scene, gradients| {
            let mut changed = free_space.clear(scene, &cameras);
            let Some(growth) = growth else { return (!changed.is_empty()).then_some(changed) };
            changed.extend(growth.apply(scene, gradients, along, rate));
            Some(changed)
        })
    }

    fn stop(&mut self, done: usize, why: StopReason) -> Result<Option<StopReason>> {
        self.evaluate(done)?;
        self.keep();
        Ok(Some(why))
    }

    fn next_views(&mut self) -> Result<Vec<View>> {
        let count = self.options.views_per_step;
        while self.upcoming.len() < count + rayon::current_num_threads() {
            self.upcoming.push_back(self.training[self.order.next()]);
        }
        let now: Vec<usize> = self.upcoming.drain(..count).collect();
        let views = self.photos.views(self.cameras.all(), &now, self.upcoming.make_contiguous(), self.factor);
        // The step may be taken later.
        if views.is_err() {
            now.iter().rev().for_each(|photo| self.upcoming.push_front(*photo));
        }
        views
    }

    fn step_photos(&mut self, step: usize, found: &[PhotoLoss]) {
        let (rate, along) = (self.schedule.rate(step), step as f64 / self.schedule.steps as f64);
        for PhotoLoss { photo, d_pose, d_exposure, .. } in found {
            d_pose.iter().for_each(|d_pose| self.cameras.step(*photo, *d_pose, rate, along));
            if let (Some(exposures), Some(gradient)) = (&mut self.exposures, d_exposure) {
                exposures.step(*photo, *gradient, rate);
            }
        }
        self.exposures.iter_mut().for_each(Exposures::center);
    }

    fn resize(&mut self, step: usize) {
        let factor = self.schedule.factor(step, self.shortest());
        if self.factor != factor {
            (self.factor, self.began, self.least, self.latest) = (factor, step, f32::INFINITY, 0.0);
            let largest = self.sizes(factor).max_by_key(|[width, height]| width * height);
            self.sizes.extend(largest.map(|size| (step, size)));
        }
    }

    /// Marks a checkpoint when held-out PSNR or, without held-out photos, the mean loss at this
    /// size improves.
    fn evaluate(&mut self, step: usize) -> Result<()> {
        if self.evaluated == Some(step) {
            return Ok(());
        }
        self.evaluated = Some(step);
        self.keep();
        if !self.validation.is_empty() {
            let mut sum = 0.0;
            for view in &self.validation {
                let (mut drawn, _) = self.gaussians.draw(view)?;
                if self.exposures.is_some() {
                    drawn = ColorTransform::fit(&view.image.kept(&drawn), &view.values()).apply(&drawn);
                }
                sum += view.psnr(&drawn) / self.validation.len() as f64;
            }
            self.holdout_psnr.push((step, sum));
            let best = self.holdout_psnr.iter().fold(f64::NEG_INFINITY, |best, (_, psnr)| best.max(*psnr));
            let given = self.holdout_psnr[0].1;
            // False for NaN, too.
            let is_good = sum > (best - SLACK).max(given);
            if !is_good {
                return Ok(());
            }
        }
        if step > 0 && (!self.validation.is_empty() || self.latest <= self.least) {
            let cameras = self.cameras.all().to_vec();
            let (scene, exposures) = (self.scene()?, self.exposures.clone());
            self.next = Some(Kept { step, scene, cameras, exposures });
        }
        Ok(())
    }

    fn scene(&mut self) -> Result<Scene> {
        let mut scene = self.gaussians.scene()?;
        if self.growth.is_some() {
            drop_invisible(&mut scene);
        }
        Ok(scene)
    }

    fn keep(&mut self) {
        if let Some(next) = self.next.take() {
            self.kept = next;
        }
    }

    /// A loss is of the Gaussians before its step: it validates the marked checkpoint, not the
    /// current state.
    fn check_loss(&mut self) -> Option<String> {
        let hides = usize::from(self.gaussians.dropout > 0.0);
        let count = self.training.len().div_ceil(self.options.views_per_step).max(hides * self.interval);
        let last = self.losses.len().checked_sub(count).filter(|first| *first >= self.began)?;
        let loss = self.losses[last..].iter().sum::<f32>() / count as f32;
        if loss > DIVERGED[hides] * self.least {
            return Some(format!("the loss grew from {:.4} to {loss:.4}", self.least));
        }
        (self.latest, self.least) = (loss, self.least.min(loss));
        None
    }
}
