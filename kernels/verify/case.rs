use crate::{Mode, Tolerance, Worst, bound::half};
use std::fmt::Debug;
use zipsplat::{Result, gpu::Device};

/// Error over bound of a caught fault; rounding may cancel one bound.
pub const CAUGHT: f64 = 2.0;

pub(crate) trait Problem: 'static {
    type Output;
    type Truth;
    type Fault: Copy + Debug + 'static;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Self::Output>;

    fn truth(&self, mode: Mode) -> Self::Truth;

    fn judge(&self, truth: &Self::Truth, output: &Self::Output, mode: Mode) -> Worst;

    /// Deviation that tests allow: at random, sums stay far below their bounds.
    fn typical(&self, _device: &Device, _mode: Mode) -> Tolerance {
        Tolerance::ANY
    }

    /// Simulates a fault; each output must be caught. Empty if the mode's rounding hides it.
    fn faulty(&self, truth: &Self::Truth, fault: Self::Fault, mode: Mode) -> Vec<Self::Output>;

    /// Zeros, which every case must catch unless they are right.
    fn zeros(&self, _truth: &Self::Truth) -> Option<Self::Output> {
        None
    }
}

/// Output as a list of numbers, each with its own bound.
pub(crate) trait Values: 'static {
    type Fault: Copy + Debug + 'static;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Vec<f32>>;

    /// Truth and bounds.
    fn truth(&self, mode: Mode) -> [Vec<f64>; 2];

    fn typical(&self, _mode: Mode) -> Tolerance {
        Tolerance::ANY
    }

    fn faulty(&self, truth: &[f64], fault: Self::Fault) -> Vec<f64>;
}

impl<V: Values> Problem for V {
    type Output = Vec<f32>;
    type Truth = [Vec<f64>; 2];
    type Fault = V::Fault;

    fn compute(&self, device: &Device, mode: Mode) -> Result<Vec<f32>> {
        Values::compute(self, device, mode)
    }

    fn truth(&self, mode: Mode) -> [Vec<f64>; 2] {
        Values::truth(self, mode)
    }

    fn judge(&self, [truth, bounds]: &[Vec<f64>; 2], output: &Vec<f32>, _: Mode) -> Worst {
        Worst::of(output, truth, |i| bounds[i])
    }

    fn typical(&self, _: &Device, mode: Mode) -> Tolerance {
        Values::typical(self, mode)
    }

    fn faulty(&self, [truth, _]: &[Vec<f64>; 2], fault: V::Fault, _: Mode) -> Vec<Vec<f32>> {
        if truth.is_empty() {
            return Vec::new();
        }
        vec![Values::faulty(self, truth, fault).into_iter().map(|x| x as f32).collect()]
    }

    fn zeros(&self, [truth, _]: &[Vec<f64>; 2]) -> Option<Vec<f32>> {
        Some(vec![0.0; truth.len()])
    }
}

pub(crate) fn shifted(values: &[f64], by: usize) -> Vec<f64> {
    (0..values.len()).map(|i| values[(i + by) % values.len()]).collect()
}

pub(crate) fn joined<const N: usize>(tensors: &[Vec<f32>; N], widths: [usize; N]) -> Vec<f32> {
    let row = |n: usize| tensors.iter().zip(widths).flat_map(move |(x, width)| &x[n * width..][..width]);
    (0..tensors[0].len() / widths[0]).flat_map(row).copied().collect()
}

pub(crate) fn halves(values: &[f64]) -> Vec<f64> {
    values.iter().map(|&x| half(x)).collect()
}

/// Faults that a case must catch besides zeros.
#[derive(Clone)]
pub(crate) struct Catches<F>(Vec<F>);

impl<F: Copy, const N: usize> From<[F; N]> for Catches<F> {
    fn from(faults: [F; N]) -> Self {
        Self(faults.to_vec())
    }
}

impl<F: Copy> Catches<F> {
    pub fn and(mut self, more: &[F]) -> Self {
        self.0.extend_from_slice(more);
        self
    }
}

#[derive(Clone, Debug)]
pub struct Injected {
    pub fault: String,
    /// Least error over bound among the fault's outputs.
    pub share: f64,
}

impl Injected {
    pub fn is_caught(&self) -> bool {
        self.share > CAUGHT
    }
}

pub struct Case {
    pub name: String,
    pub size: usize,
    pub catches: Vec<String>,
    checks: Box<dyn Checks>,
}

impl Case {
    /// Joins problems; each must catch every fault.
    pub(crate) fn sweep<P: Problem>(
        name: impl Into<String>,
        size: usize,
        faults: impl Into<Catches<P::Fault>>,
        make: impl Fn() -> Vec<P> + 'static,
    ) -> Self {
        let Catches(faults) = faults.into();
        let catches = faults.iter().map(name_of).collect();
        Self { name: name.into(), size, catches, checks: Box::new(Made { make, faults }) }
    }

    pub(crate) fn check(&self, device: &Device, mode: Mode) -> Result<Worst> {
        self.checks.check(device, mode)
    }

    /// Checks the injected faults without a device.
    pub fn inject(&self, mode: Mode) -> Vec<Injected> {
        self.checks.inject(mode)
    }
}

/// Type-erased problems, built on use because they are large.
trait Checks {
    fn check(&self, device: &Device, mode: Mode) -> Result<Worst>;
    fn inject(&self, mode: Mode) -> Vec<Injected>;
}

struct Made<M, F> {
    make: M,
    faults: Vec<F>,
}

impl<P: Problem, M: Fn() -> Vec<P>> Checks for Made<M, P::Fault> {
    fn check(&self, device: &Device, mode: Mode) -> Result<Worst> {
        (self.make)().iter().try_fold(Worst::NONE, |worst, problem| {
            let output = problem.compute(device, mode)?;
            let judged = problem.judge(&problem.truth(mode), &output, mode);
            Ok(worst.or(judged.against(problem.typical(device, mode))))
        })
    }

    fn inject(&self, mode: Mode) -> Vec<Injected> {
        let problems: Vec<_> = (self.make)().into_iter().map(|problem| (problem.truth(mode), problem)).collect();
        let inject = |fault: Option<&P::Fault>| {
            let shares = problems.iter().flat_map(|(truth, problem)| {
                let share = |output: &P::Output| problem.judge(truth, output, mode).share;
                match fault {
                    Some(fault) => problem.faulty(truth, *fault, mode).iter().map(share).collect::<Vec<_>>(),
                    None => problem.zeros(truth).iter().map(share).filter(|share| *share > 0.0).collect(),
                }
            });
            let name = fault.map_or_else(|| "zeros".into(), name_of);
            shares.reduce(f64::min).map(|share| Injected { fault: name, share })
        };
        self.faults.iter().map(Some).chain([None]).filter_map(inject).collect()
    }
}

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
