//! A bar on a terminal, else occasional lines.

use crate::process::lock;
use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use std::{
    fmt,
    io::{IsTerminal, Write, stderr},
    ops::ControlFlow,
    sync::{
        Mutex,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, channel},
    },
    time::{Duration, Instant},
};
use zipsplat::{Error, Result, gpu::Progress};

const PATIENCE: Duration = Duration::from_secs(1);
/// Delay before the first progress line off a terminal.
pub(super) const FIRST_LINE: Duration = Duration::from_secs(5);
const BETWEEN_LINES: Duration = Duration::from_secs(30);
const ESTIMABLE: f64 = 0.02;
const STEPS: u64 = 1000;

pub struct Stage<'a> {
    bar: ProgressBar,
    cancelled: &'a AtomicBool,
}

impl<'a> Stage<'a> {
    pub(super) fn new(name: &str, task: &str, cancelled: &'a AtomicBool) -> Self {
        let bar = ProgressBar::with_draw_target(Some(STEPS), ProgressDrawTarget::hidden());
        let style =
            ProgressStyle::with_template("{spinner} {prefix}{msg:16} [{bar:32}] {percent:>3} % {elapsed}{left}");
        let left = |state: &ProgressState, out: &mut dyn fmt::Write| {
            let left = time_left(state.elapsed(), state.pos());
            let _ = left.map_or(Ok(()), |left| write!(out, ", {left:#} left"));
        };
        bar.set_style(style.expect("the template is valid").with_key("left", left));
        Self { bar: bar.with_message(name.to_owned()).with_prefix(task.to_owned()), cancelled }
    }

    pub(super) fn shown<T>(&self, next_line: &Mutex<Instant>, body: impl FnOnce(&Self) -> T) -> T {
        let mut result = None;
        self.watched(next_line, Box::new(|stage| result = Some(body(stage))));
        result.expect("the body has run")
    }

    /// Compiled once, not for each stage.
    fn watched(&self, next_line: &Mutex<Instant>, body: Box<dyn FnOnce(&Self) + '_>) {
        std::thread::scope(|scope| {
            // Its drop after the body or a panic ends the wait.
            let (_done, done) = channel::<()>();
            let bar = &self.bar;
            let show =
                move || if stderr().is_terminal() { show_bar(bar, &done) } else { print_lines(bar, &done, next_line) };
            scope.spawn(show);
            body(self);
        });
        self.bar.finish_and_clear();
    }

    pub fn told_to(bar: &ProgressBar, cancelled: &'a AtomicBool) -> Self {
        bar.set_length(STEPS);
        bar.set_position(0);
        Self { bar: bar.clone(), cancelled }
    }

    /// `Break` on cancellation.
    pub fn at(&self, fraction: f64) -> ControlFlow<()> {
        self.bar.set_position((fraction * STEPS as f64) as u64);
        self.go_on()
    }

    pub fn go_on(&self) -> ControlFlow<()> {
        if self.cancelled.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    pub fn follow(&self, progress: Progress<'_>) -> ControlFlow<()> {
        self.name(progress.scope);
        self.at(progress.fraction)
    }

    /// Hidden stage with the same cancellation, for parallel steps.
    pub fn silent(&self) -> Stage<'_> {
        Stage { bar: ProgressBar::hidden(), cancelled: self.cancelled }
    }

    pub fn name(&self, name: &str) {
        self.bar.set_message(name.to_owned());
    }

    pub fn reach(&self, fraction: f64) -> Result<()> {
        if self.at(fraction).is_break() { Err(Error::Cancelled) } else { Ok(()) }
    }

    pub fn each<T, U>(&self, items: &[T], mut body: impl FnMut(&T) -> Result<U>) -> Result<Vec<U>> {
        let (name, all) = (self.bar.message(), items.len());
        let step = |(i, item)| {
            self.name(&format!("{name} {} of {all}", i + 1));
            self.reach(i as f64 / all as f64).and_then(|()| body(item))
        };
        items.iter().enumerate().map(step).collect()
    }

    pub fn check(&self) -> Result<()> {
        if self.cancelled.load(Ordering::Relaxed) { Err(Error::Cancelled) } else { Ok(()) }
    }
}

fn show_bar(bar: &ProgressBar, done: &Receiver<()>) {
    if done.recv_timeout(PATIENCE) == Err(RecvTimeoutError::Timeout) {
        bar.set_draw_target(ProgressDrawTarget::stderr());
        bar.enable_steady_tick(Duration::from_millis(100));
    }
}

fn print_lines(bar: &ProgressBar, done: &Receiver<()>, next_line: &Mutex<Instant>) {
    let due = || lock(next_line);
    loop {
        let wait = due().saturating_duration_since(Instant::now());
        let wait = wait.max(PATIENCE.saturating_sub(bar.elapsed()));
        if done.recv_timeout(wait) != Err(RecvTimeoutError::Timeout) {
            return;
        }
        let mut due = due();
        // Another stage may have printed one.
        if *due <= Instant::now() {
            *due = Instant::now() + BETWEEN_LINES;
            let _ = writeln!(stderr(), "{}", progress_line(bar));
        }
    }
}

fn progress_line(bar: &ProgressBar) -> String {
    let (elapsed, name) = (bar.elapsed(), format!("{}{}", bar.prefix(), bar.message()));
    match time_left(elapsed, bar.position()) {
        Some(left) => format!("{name}: {} %, about {left} left", 100 * bar.position() / STEPS),
        None => format!("{name}: {} so far", HumanDuration(elapsed)),
    }
}

fn time_left(elapsed: Duration, steps: u64) -> Option<HumanDuration> {
    let fraction = steps as f64 / STEPS as f64;
    (fraction >= ESTIMABLE).then(|| HumanDuration(elapsed.mul_f64((1.0 / fraction - 1.0).max(0.0))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_progress_estimate_the_rest() {
        assert_eq!(
            time_left(Duration::from_secs(60), STEPS / 4).map(|left| left.to_string()),
            Some("3 minutes".into())
        );
        assert!(time_left(Duration::from_secs(60), STEPS / 100).is_none(), "a hundredth tells little");
        let bar = ProgressBar::hidden().with_message("align").with_prefix("2 of 3, kitchen: ");
        assert_eq!(progress_line(&bar), "2 of 3, kitchen: align: 0 seconds so far");
        bar.set_position(STEPS / 2);
        assert_eq!(progress_line(&bar), "2 of 3, kitchen: align: 50 %, about 0 seconds left");
    }
}
