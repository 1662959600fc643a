//! Fast kernels against their exact twins, once per device and driver, so that none is used where it computes wrongly.

use super::{Candidate, OPERATIONS, Operation, cache::cache_file};
use crate::{Error, Result, gpu::Device, ops::Arithmetic, types::write_atomic};
use std::{
    collections::{BTreeMap, HashSet},
    fs,
    path::Path,
    time::Duration,
};

/// How often a test is begun that never ends, because the driver ends the process or hangs, or somebody else ends it.
const ATTEMPTS: u32 = 2;
/// A test that was begun longer ago than this, which it takes in seconds, did not end.
const PATIENCE: Duration = Duration::from_secs(60);
/// Stands for all kernels of a test that was begun [`ATTEMPTS`] times and never ended.
const UNFINISHED: &str = "the self-test";

/// What the kernels of one device were found to do.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SelfTest {
    /// Largest deviation of each kernel that the device can run, by name and relative to what passes: above 1 it is not used.
    /// None where it gave no number.
    pub deviations: BTreeMap<String, Option<f64>>,
    /// Kernels that were tested before this run, which goes on with the others.
    #[serde(skip)]
    before: HashSet<String>,
}

impl SelfTest {
    /// Runs every fast kernel that the device can run.
    ///
    /// # Errors
    /// A failure of the device.
    pub fn run(device: &Device) -> Result<Self> {
        let mut test = Self::default();
        test.run_all(device).map(|()| test)
    }

    /// The result for a device, out of the user's cache where it was found before.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], [`Error::Memory`]; other failures are those of its kernels.
    pub fn of(device: &Device) -> Result<Self> {
        let file = cache_file(device, "self-test");
        let Record { begun, result, whole } = file.as_deref().and_then(Record::read).unwrap_or_default();
        let mut test = match result {
            Some(test) if whole => return Ok(test),
            found => found.unwrap_or_default(),
        };
        if begun >= ATTEMPTS {
            test.deviations.insert(UNFINISHED.into(), None);
            return Ok(test);
        }
        Record { begun: begun + 1, result: Some(test.clone()), whole: false }.keep(file.as_deref());
        let outcome = test.run_all(device);
        if let Err(error @ Error::Memory { .. }) = outcome {
            // Another time there may be enough.
            let _ = file.map(fs::remove_file);
            return Err(error);
        }
        // Also where the device was lost: the kernel that was at work then is not used again.
        Record { begun: 0, result: Some(test.clone()), whole: outcome.is_ok() }.keep(file.as_deref());
        outcome.map(|()| test)
    }

    /// What is wrong with the kernels that failed, in words for the user.
    pub(super) fn notes(&self, device: &Device) -> Vec<String> {
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
        self.deviations.iter().filter(|(kernel, _)| !self.passed(kernel)).map(note).collect()
    }

    /// An arithmetic without the matrix kernels that failed; `None` where those that would replace them failed, too.
    pub(super) fn allowed(&self, wanted: Arithmetic) -> Option<Arithmetic> {
        let mut allowed = wanted;
        for operation in OPERATIONS {
            let passed =
                |on_units, factor| operation.kernels(on_units, factor).iter().all(|(kernel, _)| self.passed(kernel));
            if operation.lanes().contains(&wanted.element) && !passed(false, wanted.element) {
                return None;
            }
            for units in operation.chosen(&mut allowed) {
                *units = units.filter(|units| passed(true, units.factor));
            }
        }
        (allowed.quantised.is_some() == wanted.quantised.is_some()).then_some(allowed)
    }

    /// All that have not been tested yet.
    fn run_all(&mut self, device: &Device) -> Result<()> {
        let limits = device.limits();
        self.before = self.deviations.keys().cloned().collect();
        if !limits.half_storage {
            return Ok(());
        }
        for operation in OPERATIONS {
            for element in operation.lanes() {
                self.test(device, operation, Candidate::Lanes(*element))?;
            }
            for (units, candidates) in operation.on_units(limits) {
                // A kernel none of whose tiles is within the device's limits fails.
                if candidates.is_empty() {
                    operation.kernels(true, units.factor).iter().for_each(|(kernel, _)| self.found(kernel, None));
                }
                candidates.into_iter().try_for_each(|candidate| self.test(device, operation, candidate))?;
            }
        }
        Ok(())
    }

    /// Tests the kernels of a candidate. One that a driver refuses, or that loses the device, gives no result; only what would
    /// stop the others, too, is an error.
    fn test(&mut self, device: &Device, operation: &dyn Operation, candidate: Candidate) -> Result<()> {
        let kernels = match candidate {
            Candidate::Lanes(element) => operation.kernels(false, element),
            Candidate::Units(units, _) => operation.kernels(true, units.factor),
        };
        for (kernel, output) in kernels {
            if self.before.contains(&kernel) {
                continue;
            }
            match operation.deviation(device, candidate, output) {
                Ok(deviation) => self.found(&kernel, deviation),
                Err(error @ Error::Memory { .. }) => return Err(error),
                Err(error) => {
                    self.found(&kernel, None);
                    if matches!(error, Error::DeviceLost) {
                        return Err(error);
                    }
                }
            }
        }
        Ok(())
    }

    fn passed(&self, kernel: &str) -> bool {
        self.deviations.get(kernel).copied().flatten().is_some_and(|times| times <= 1.0)
    }

    /// Keeps the largest deviation of a kernel, over its tiles and problems.
    fn found(&mut self, kernel: &str, deviation: Option<f64>) {
        let worst = self.deviations.entry(kernel.into()).or_insert(deviation);
        *worst = worse(*worst, deviation);
    }
}

/// The larger of two deviations; none where one of them is no number.
pub(super) fn worse(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.zip(b).map(|(a, b)| a.max(b))
}

/// The largest difference of two results, relative to `limit` times the rms of the exact one: above 1 a kernel does not pass.
/// None where there is no such number. `stored` is the unit roundoff of what the fast results are kept in: Vulkan lets a device
/// round to either neighbour.
pub(super) fn deviation(limit: f64, stored: f64, exact: &[f32], fast: &[f32]) -> Option<f64> {
    let rms = (exact.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>() / exact.len() as f64).sqrt();
    let largest = exact.iter().fold(0.0, |most, x| f64::from(x.abs()).max(most));
    let limit = limit + 2.0 * stored * largest / rms;
    let apart = |(a, b): (&f32, &f32)| f64::from((a - b).abs());
    // Unlike f64::max, which loses NaN.
    let larger = |a: f64, b: f64| if a.is_nan() || b <= a { a } else { b };
    let worst = exact.iter().zip(fast).map(apart).fold(0.0, larger);
    Some(worst / rms / limit).filter(|deviation| deviation.is_finite())
}

/// What is known of a device: the result, and until it is whole how often the test was begun.
#[derive(Default, serde::Serialize, serde::Deserialize)]
struct Record {
    begun: u32,
    result: Option<SelfTest>,
    /// Not where the device was lost by a kernel: the others are tested the next time.
    #[serde(default)]
    whole: bool,
}

impl Record {
    /// What is kept in a file. One that is damaged is not there, and a test that is under way was not begun.
    fn read(file: &Path) -> Option<Self> {
        let mut known: Self = serde_json::from_slice(&fs::read(file).ok()?).ok()?;
        let age = fs::metadata(file).and_then(|found| found.modified()).ok()?.elapsed().unwrap_or(PATIENCE);
        known.result = known.result.filter(|test| !test.deviations.is_empty());
        known.begun -= u32::from(known.begun > 0 && age < PATIENCE);
        Some(known)
    }

    /// Remembers it; what cannot be kept is found anew.
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
            let mut test = SelfTest::default();
            test.found("kernel", deviation(1e-3, 0.0, &exact, &fast));
            test.passed("kernel")
        };
        assert!(passed(exact) && passed([1.0009, -1.0, 1.0]));
        assert!(
            !passed([1.0011, -1.0, 1.0]) && !passed([f32::NAN, -1.0, 1.0]) && !passed([1.0, f32::INFINITY, f32::NAN])
        );
        assert!(!SelfTest::default().passed("kernel"), "what was not tested");
        let mut test = SelfTest::default();
        for fast in [exact, [f32::NAN; 3], exact] {
            test.found("kernel", deviation(1e-3, 0.0, &exact, &fast));
        }
        assert_eq!(test.deviations, [("kernel".to_owned(), None)].into(), "its worst result counts");
    }
}
