use super::{Kept, Refinement};
use crate::{
    Error, Result,
    refine::{
        RefineCheckpoint, RefineOptions, StopReason,
        cameras::poses,
        checkpoint::{Identity, State},
        exposure::Exposures,
    },
};
use std::time::{Duration, Instant};

/// Where and when a refinement is saved.
pub struct Saving {
    pub checkpoint: RefineCheckpoint,
    pub identity: Identity,
    /// Steps, largest photo's width and height, and Gaussians, possibly measured.
    plan: [u64; 4],
    last: Instant,
    /// Time before this run.
    spent: f64,
}

/// No number of a plan.
const NONE: u64 = u64::MAX;

impl Saving {
    pub fn new(checkpoint: RefineCheckpoint, identity: Identity) -> Self {
        Self { checkpoint, identity, plan: [NONE; 4], last: Instant::now(), spent: 0.0 }
    }

    pub fn plan(&mut self, steps: usize, options: &RefineOptions) {
        let [width, height] = options.max_image_size.map_or([NONE; 2], |size| size.map(u64::from));
        self.plan = [steps as u64, width, height, options.max_gaussians.map_or(NONE, |most| most as u64)];
    }

    /// Restores the plan and returns its steps.
    pub fn restore(&mut self, state: &mut State<'_>, options: &mut RefineOptions) -> Result<usize> {
        self.state(state)?;
        let [steps, width, height, most] = self.plan;
        options.max_image_size = (width != NONE).then_some([width as u32, height as u32]);
        options.max_gaussians = (most != NONE).then_some(most as usize);
        Ok(steps as usize)
    }

    fn state(&mut self, state: &mut State<'_>) -> Result<()> {
        state.fixed("plan", &mut self.plan)?;
        state.fixed("seconds", std::slice::from_mut(&mut self.spent))
    }

    pub fn spent(&self) -> Duration {
        Duration::try_from_secs_f64(self.spent).unwrap_or_default()
    }

    pub fn is_due(&self) -> bool {
        self.last.elapsed() >= self.checkpoint.interval
    }
}

impl Refinement<'_> {
    pub fn save(&mut self, saving: &mut Saving, mut done: usize, begin: Instant) -> Result<()> {
        let mut state = State::Save(Vec::new());
        saving.spent = begin.elapsed().as_secs_f64();
        saving.state(&mut state)?;
        self.state(&mut state, &mut done)?;
        let State::Save(values) = state else { unreachable!("it saves") };
        saving.checkpoint.save(&saving.identity, &values)?;
        saving.last = Instant::now();
        Ok(())
    }

    /// Ends the refinement before `step`, with a checkpoint.
    pub(super) fn interrupt(
        &mut self,
        error: Error,
        step: usize,
        saving: Option<&mut Saving>,
        begin: Instant,
    ) -> Result<Option<StopReason>> {
        let saved = saving.map_or(Ok(()), |saving| self.save(saving, step, begin));
        let why = match (error, saved) {
            (Error::Cancelled, Ok(())) => StopReason::Cancelled,
            (Error::Cancelled, Err(error)) | (error, _) => StopReason::Failed(error.to_string()),
        };
        self.stop(step, why)
    }

    /// Loads the state and returns its finished steps.
    pub fn load(&mut self, state: &mut State<'_>) -> Result<usize> {
        let mut done = 0;
        self.state(state, &mut done)?;
        if self.exposures.is_some() {
            self.gaussians.learn_exposures();
        }
        Ok(done)
    }

    fn state(&mut self, state: &mut State<'_>, done: &mut usize) -> Result<()> {
        state.count("done", done)?;
        self.gaussians.state(state)?;
        self.cameras.state(state)?;
        self.order.state(state)?;
        self.growth.iter_mut().try_for_each(|growth| growth.state(state))?;
        let mut upcoming: Vec<u64> = self.upcoming.iter().map(|photo| *photo as u64).collect();
        state.list("upcoming", &mut upcoming)?;
        self.upcoming = upcoming.into_iter().map(|photo| photo as usize).collect();
        let evaluated = self.evaluated.map_or(0, |step| step + 1);
        let clears = usize::from(self.free_space.is_some());
        let numbers = [self.factor as usize, self.began, evaluated, self.interval, self.first_exposed, clears];
        let mut numbers = numbers.map(|n| n as u64);
        state.fixed("numbers", &mut numbers)?;
        let [factor, began, evaluated, interval, first_exposed, clears] = numbers.map(|n| n as usize);
        (self.factor, self.began, self.evaluated) = (factor as u32, began, evaluated.checked_sub(1));
        (self.interval, self.first_exposed) = (interval.max(1), first_exposed);
        // Planned steps may have changed.
        if self.free_space.is_some() != (clears == 1) {
            self.find_free_space(clears == 1);
        }
        let mut losses = [self.least, self.latest];
        state.fixed("mean_losses", &mut losses)?;
        [self.least, self.latest] = losses;
        state.list("losses", &mut self.losses)?;
        let psnr = |(step, psnr): &(usize, f64)| [*step as f64, *psnr];
        state.mapped("holdout_psnr", &mut self.holdout_psnr, psnr, |[step, psnr]| (step as usize, psnr))?;
        let size = |(step, [width, height]): &(usize, [u32; 2])| [*step as u64, (*width).into(), (*height).into()];
        let read = |[step, width, height]: [u64; 3]| (step as usize, [width as u32, height as u32]);
        state.mapped("sizes", &mut self.sizes, size, read)?;
        let (options, training, count) = (&self.options, &self.training[..], self.cameras.all().len());
        let exposures = |state: &mut State<'_>, name: &str, exposures: &mut Option<Exposures>| {
            Exposures::state(state, name, exposures, options, training, count)
        };
        exposures(state, "exposures", &mut self.exposures)?;
        let mut has_next = usize::from(self.next.is_some());
        state.count("has_next", &mut has_next)?;
        if has_next == 1 && self.next.is_none() {
            self.next = Some(self.kept.clone());
        }
        for (name, kept) in [("kept", Some(&mut self.kept)), ("next", self.next.as_mut())] {
            let Some(Kept { step, scene, cameras, exposures: of_kept }) = kept else { continue };
            state.count(&format!("{name}.step"), step)?;
            state.scene(name, scene)?;
            poses(state, &format!("{name}.cameras"), cameras)?;
            exposures(state, &format!("{name}.exposures"), of_kept)?;
        }
        Ok(())
    }
}
