//! A case: what a device computes, its truth, and what kernels with faults would make of it.

use super::{Mode, Worst};
use std::fmt::Debug;
use zipsplat::{Result, gpu::Device};

/// How many times its bound a faulty result has to miss the truth by. A device with that fault also rounds, and rounding
/// within the bound may take back one of them.
pub const CAUGHT: f64 = 2.0;

/// The parts of a case.
pub(super) trait Problem: 'static {
    /// The result of the device.
    type Output;
    /// The right result, and the bound of each element.
    type Truth;
    /// Ways in which a kernel may be wrong.
    type Fault: Copy + Debug + 'static;

    /// Runs the kernels.
    fn compute(&self, device: &Device, mode: Mode) -> Result<Self::Output>;

    /// The same in f64, of what the device holds in this mode.
    fn truth(&self, mode: Mode) -> Self::Truth;

    /// The worst element of an output.
    fn judge(&self, truth: &Self::Truth, output: &Self::Output, mode: Mode) -> Worst;

    /// The results of kernels with a fault, computed on the host; none where the mode's own rounding is as large. Of several
    /// each has to be caught.
    fn faulty(&self, truth: &Self::Truth, fault: Self::Fault, mode: Mode) -> Vec<Self::Output>;
}

/// Faults that a case is there to catch: at least one, or it would prove nothing.
pub(super) struct Catches<F>(Vec<F>);

impl<F: Copy, const N: usize> From<[F; N]> for Catches<F> {
    fn from(faults: [F; N]) -> Self {
        const { assert!(N > 0, "a case that catches nothing proves nothing") };
        Self(faults.to_vec())
    }
}

impl<F: Copy> Catches<F> {
    /// Adds more to these.
    pub fn and(mut self, more: &[F]) -> Self {
        self.0.extend_from_slice(more);
        self
    }
}

/// A fault, fed through a case's own check.
#[derive(Clone, Debug)]
pub struct Injected {
    /// The fault's name: `last term`.
    pub fault: String,
    /// The share of the bound that it misses the truth by: the least, where it stands for several.
    pub share: f64,
}

impl Injected {
    /// Whether no rounding can hide it.
    pub fn is_caught(&self) -> bool {
        self.share > CAUGHT
    }
}

/// One hard input.
pub struct Case {
    /// The difficulty of the case.
    pub name: String,
    /// How large it is, for the report.
    pub size: usize,
    /// The faults that it is there to catch, by name.
    pub catches: Vec<String>,
    checks: Box<dyn Checks>,
}

impl Case {
    pub(super) fn new<P: Problem>(
        name: impl Into<String>,
        size: usize,
        faults: impl Into<Catches<P::Fault>>,
        make: impl Fn() -> P + 'static,
    ) -> Self {
        let Catches(faults) = faults.into();
        let catches = faults.iter().map(name_of).collect();
        Self { name: name.into(), size, catches, checks: Box::new(Made { make, faults }) }
    }

    /// Computes it on a device and compares.
    pub(super) fn check(&self, device: &Device, mode: Mode) -> Result<Worst> {
        self.checks.check(device, mode)
    }

    /// Feeds its faults through its check, without a device.
    pub fn inject(&self, mode: Mode) -> Vec<Injected> {
        self.checks.inject(mode)
    }
}

/// A problem whose types are forgotten. Problems are large: each is made where it is needed.
trait Checks {
    fn check(&self, device: &Device, mode: Mode) -> Result<Worst>;
    fn inject(&self, mode: Mode) -> Vec<Injected>;
}

struct Made<M, F> {
    make: M,
    faults: Vec<F>,
}

impl<P: Problem, M: Fn() -> P> Checks for Made<M, P::Fault> {
    fn check(&self, device: &Device, mode: Mode) -> Result<Worst> {
        let problem = (self.make)();
        let output = problem.compute(device, mode)?;
        Ok(problem.judge(&problem.truth(mode), &output, mode))
    }

    fn inject(&self, mode: Mode) -> Vec<Injected> {
        let problem = (self.make)();
        let truth = problem.truth(mode);
        let inject = |fault: &P::Fault| {
            let outputs = problem.faulty(&truth, *fault, mode);
            let shares = outputs.iter().map(|output| problem.judge(&truth, output, mode).share);
            shares.reduce(f64::min).map(|share| Injected { fault: name_of(fault), share })
        };
        self.faults.iter().filter_map(inject).collect()
    }
}

/// `LastTerm` is "last term".
fn name_of(fault: &impl Debug) -> String {
    let mut name = String::new();
    for letter in format!("{fault:?}").chars() {
        match letter {
            'A'..='Z' if !name.is_empty() => name.extend([' ', letter.to_ascii_lowercase()]),
            '(' => name.push(' '),
            ')' => {}
            _ => name.push(letter.to_ascii_lowercase()),
        }
    }
    name
}
