//! What was found is kept for the device, so that it is tested once.

use super::SelfTest;
use crate::{Error, Result, gpu::Device, ops::cache::cache_file, types::write_atomic};
use std::{fs, path::Path, time::Duration};

/// How often a test is begun that never ends, because the driver ends the process or hangs, or somebody else ends it.
const ATTEMPTS: u32 = 2;
/// A test that was begun longer ago than this, which it takes in seconds, did not end.
const PATIENCE: Duration = Duration::from_secs(60);

/// Stands for all kernels of a test that was begun [`ATTEMPTS`] times and never ended.
pub(in crate::ops) const UNFINISHED: &str = "the self-test";

/// Why, and what to do.
pub(in crate::ops) fn unfinished(device: &Device) -> String {
    let file = cache_file(device, "self-test").unwrap_or_default();
    let again = format!("remove {} to try again", file.display());
    format!(
        "{UNFINISHED} of fast kernels was begun {ATTEMPTS} times on {} and never ended; {again}",
        device.limits().name
    )
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

    /// What cannot be kept is found anew.
    fn keep(&self, file: Option<&Path>) {
        if let (Some(file), Ok(bytes)) = (file, serde_json::to_vec(self)) {
            let folder = file.parent().map(fs::create_dir_all);
            let _ = folder.and_then(Result::ok).map(|()| write_atomic(file, |out| out.write_all(&bytes)));
        }
    }
}

impl SelfTest {
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
}
