use super::{Candidate, OPERATIONS, Operation, cache::cache_file, on_lanes};
use crate::{
    Error, Result,
    gpu::{Device, Element, Limits},
    ops::{Arithmetic, Lanes},
    types::write_atomic,
};
use std::{collections::BTreeMap, fs, ops::ControlFlow, path::Path, time::Duration};

/// Unfinished tests before giving up: drivers may hang or crash.
const ATTEMPTS: u32 = 2;
/// Time without progress of an unfinished test.
const PATIENCE: Duration = Duration::from_secs(120);
const UNFINISHED: &str = "the self-test";

/// Deviations of a device's kernels.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SelfTest {
    /// Relative to tolerance: above 1 fails.
    pub deviations: BTreeMap<String, Option<f64>>,
}

struct Group {
    operation: &'static Operation,
    kernels: Vec<(String, Element)>,
    candidates: Vec<Candidate>,
}

impl SelfTest {
    pub fn run(device: &Device) -> Result<Self> {
        let mut test = Self::default();
        test.run_groups(device, Group::all(device.limits()), |_, _| ControlFlow::Continue(()), |_| ())?;
        Ok(test)
    }

    /// Returns cached or new results. Only failures that stop the other kernels are errors.
    pub fn of(device: &Device, wanted: Arithmetic, progress: impl FnMut(&str, f64) -> ControlFlow<()>) -> Result<Self> {
        let file = cache_file(device, "self-test");
        let Record { begun, result } = file.as_deref().and_then(Record::read).unwrap_or_default();
        let mut test = result.unwrap_or_default();
        let mut groups = Group::of(device.limits(), wanted);
        groups.iter_mut().for_each(|group| group.kernels.retain(|(kernel, _)| !test.deviations.contains_key(kernel)));
        groups.retain(|group| !group.kernels.is_empty());
        if groups.is_empty() {
            return Ok(test);
        }
        if begun >= ATTEMPTS {
            test.deviations.insert(UNFINISHED.into(), None);
            return Ok(test);
        }
        let keep = |begun: u32, test: &Self| Record { begun, result: Some(test.clone()) }.keep(file.as_deref());
        keep(begun + 1, &test);
        let outcome = test.run_groups(device, groups, progress, |test| keep(begun + 1, test));
        // Retry after out of memory or cancellation, not device loss.
        keep(if matches!(outcome, Err(Error::Memory { .. } | Error::Cancelled)) { begun } else { 0 }, &test);
        outcome.map(|()| test)
    }

    /// Failures of kernels that `wanted` would use.
    pub(super) fn notes(&self, device: &Device, wanted: Arithmetic) -> Vec<String> {
        let used: Vec<(String, Element)> =
            Group::of(device.limits(), wanted).into_iter().flat_map(|group| group.kernels).collect();
        let is_used = |kernel: &str| kernel == UNFINISHED || used.iter().any(|(name, _)| name == kernel);
        let name = &device.limits().name;
        let note = |(kernel, deviation): (&String, &Option<f64>)| match deviation {
            Some(times) => format!("{kernel} deviates {times:.1} times what it may on {name}: not used"),
            None if kernel == UNFINISHED => {
                let file = cache_file(device, "self-test").unwrap_or_default();
                let again = format!("remove {} to try again", file.display());
                format!("{kernel} of fast kernels was begun {ATTEMPTS} times on {name} and never ended; {again}")
            }
            None => format!("{kernel} gave no result on {name}: not used"),
        };
        self.deviations.iter().filter(|(kernel, _)| is_used(kernel) && !self.passed(kernel)).map(note).collect()
    }

    /// Removes failed matrix kernels; `None` if their replacements failed too.
    pub(super) fn allowed(&self, wanted: Arithmetic) -> Option<Arithmetic> {
        let mut allowed = wanted;
        for operation in &OPERATIONS {
            let passed =
                |on_units, factor| (operation.kernels)(on_units, factor).iter().all(|(kernel, _)| self.passed(kernel));
            if operation.lanes.contains(&wanted.element) && !passed(false, wanted.element) {
                return None;
            }
            for units in (operation.chosen)(&mut allowed) {
                *units = units.filter(|units| passed(true, units.factor));
            }
            if operation.lanes.contains(&Element::I8) {
                allowed.dots = allowed.dots.filter(|_| passed(false, Element::I8));
            }
        }
        (allowed.has_integers() == wanted.has_integers()).then_some(allowed)
    }

    /// `kept` saves results before each kernel.
    fn run_groups(
        &mut self,
        device: &Device,
        groups: Vec<Group>,
        mut progress: impl FnMut(&str, f64) -> ControlFlow<()>,
        kept: impl Fn(&Self),
    ) -> Result<()> {
        let all: usize = groups.iter().map(Group::runs).sum();
        let mut done = 0;
        for Group { operation, kernels, candidates } in groups {
            // No tile fits the device.
            let mut worst = vec![if candidates.is_empty() { None } else { Some(0.0) }; kernels.len()];
            for candidate in candidates {
                for ((kernel, output), worst) in kernels.iter().zip(&mut worst) {
                    kept(self);
                    if progress(kernel, done as f64 / all as f64).is_break() {
                        return Err(Error::Cancelled);
                    }
                    done += 1;
                    // Only errors that stop the other kernels are returned.
                    match (operation.deviation)(device, candidate, *output) {
                        Ok(deviation) => *worst = worse(*worst, deviation),
                        Err(error @ Error::Memory { .. }) => return Err(error),
                        Err(Error::DeviceLost) => {
                            self.deviations.insert(kernel.clone(), None);
                            return Err(Error::DeviceLost);
                        }
                        Err(_) => *worst = None,
                    }
                }
            }
            self.deviations.extend(kernels.into_iter().zip(worst).map(|((kernel, _), worst)| (kernel, worst)));
        }
        Ok(())
    }

    fn passed(&self, kernel: &str) -> bool {
        self.deviations.get(kernel).copied().flatten().is_some_and(|times| times <= 1.0)
    }
}

impl Group {
    fn all(limits: &Limits) -> Vec<Self> {
        Self::those(limits, |_| true, |_, _| true)
    }

    fn of(limits: &Limits, wanted: Arithmetic) -> Vec<Self> {
        let chosen = |operation: &Operation, factor| {
            (operation.chosen)(&mut { wanted }).iter().any(|units| units.is_some_and(|units| units.factor == factor))
        };
        let lanes = |element| element == wanted.element || (element == Element::I8 && wanted.dots.is_some());
        Self::those(limits, lanes, chosen)
    }

    fn those(
        limits: &Limits,
        wanted: impl Fn(Element) -> bool,
        on_units: impl Fn(&Operation, Element) -> bool,
    ) -> Vec<Self> {
        let mut groups = Vec::new();
        for operation in OPERATIONS.iter().filter(|_| limits.half_storage) {
            let lanes =
                operation.lanes.iter().copied().filter(|element| on_lanes(limits, *element) && wanted(*element));
            for element in lanes {
                let (kernels, candidates) =
                    ((operation.kernels)(false, element), vec![Candidate::Lanes(Lanes::of(element), None)]);
                groups.push(Self { operation, kernels, candidates });
            }
            for (units, candidates) in operation.on_units(limits) {
                if on_units(operation, units.factor) {
                    groups.push(Self { operation, kernels: (operation.kernels)(true, units.factor), candidates });
                }
            }
        }
        groups
    }

    fn runs(&self) -> usize {
        self.kernels.len() * self.candidates.len()
    }
}

pub(super) fn worse(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.zip(b).map(|(a, b)| a.max(b))
}

/// Largest difference relative to `limit` times the exact rms; `None` if not finite.
pub(super) fn deviation(limit: f64, stored: f64, exact: &[f32], fast: &[f32]) -> Option<f64> {
    let rms = (exact.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / exact.len() as f64).sqrt();
    let largest = exact.iter().fold(0.0, |most, x| f64::from(x.abs()).max(most));
    let limit = limit + 2.0 * stored * largest / rms;
    let apart = |(a, b): (&f32, &f32)| f64::from((a - b).abs());
    // Unlike f64::max, keeps NaN.
    let larger = |a: f64, b: f64| if a.is_nan() || b <= a { a } else { b };
    let worst = exact.iter().zip(fast).map(apart).fold(0.0, larger);
    Some(worst / rms / limit).filter(|deviation| deviation.is_finite())
}

#[derive(Default, serde::Serialize, serde::Deserialize)]
struct Record {
    begun: u32,
    result: Option<SelfTest>,
}

impl Record {
    /// A test in progress does not count as begun.
    fn read(file: &Path) -> Option<Self> {
        let mut known: Self = serde_json::from_slice(&fs::read(file).ok()?).ok()?;
        let age = fs::metadata(file).and_then(|found| found.modified()).ok()?.elapsed().unwrap_or(PATIENCE);
        known.result = known.result.filter(|test| !test.deviations.is_empty());
        known.begun -= u32::from(known.begun > 0 && age < PATIENCE);
        Some(known)
    }

    /// A failed write only costs a recomputation.
    fn keep(&self, file: Option<&Path>) {
        if let (Some(file), Ok(bytes)) = (file, serde_json::to_vec(self)) {
            let folder = file.parent().map(fs::create_dir_all);
            let _ = folder.and_then(Result::ok).map(|()| write_atomic(file, |out| out.write_all(&bytes)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_agrees_passes() {
        let exact = [1.0, -1.0, 1.0];
        let passed = |fast: [f32; 3]| {
            let deviations = [("kernel".into(), deviation(1e-3, 0.0, &exact, &fast))].into();
            SelfTest { deviations }.passed("kernel")
        };
        assert!(passed(exact) && passed([1.0009, -1.0, 1.0]));
        assert!(
            !passed([1.0011, -1.0, 1.0]) && !passed([f32::NAN, -1.0, 1.0]) && !passed([1.0, f32::INFINITY, f32::NAN])
        );
        assert!(!SelfTest::default().passed("kernel"), "what was not tested");
        let deviations = [exact, [f32::NAN; 3], exact].map(|fast| deviation(1e-3, 0.0, &exact, &fast));
        assert_eq!(deviations.into_iter().fold(Some(0.0), worse), None, "its worst result counts");
    }
}
