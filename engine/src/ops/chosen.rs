//! The arithmetic of a precision on a device: what was asked for, without kernels that failed their self-test.

use super::{
    Arithmetic, Precision, SelfTest, Tuning,
    self_test::{UNFINISHED, passes, unfinished},
};
use crate::{
    Error, Result,
    gpu::{Device, Limits},
};

impl Precision {
    /// What a device is used with where nothing is asked for: fast on GPUs with matrix units, exact on others and on CPUs,
    /// which convert f16 slowly.
    pub fn best(limits: &Limits) -> Self {
        if !limits.cpu && limits.matrices.f16.is_some() { Precision::Fast } else { Precision::Exact }
    }
}

/// A precision and its arithmetic on a device.
#[derive(Clone, Debug)]
pub struct Chosen {
    /// The precision.
    pub precision: Precision,
    /// Its arithmetic.
    pub arithmetic: Arithmetic,
    /// Kernels that failed their self-test.
    pub notes: Vec<String>,
}

impl Chosen {
    /// The arithmetic of a precision on a device; of its best, where none is asked for.
    ///
    /// # Errors
    /// [`Error::Argument`] where the device cannot compute in the precision asked for; a failure of the device.
    pub fn of(device: &Device, precision: Option<Precision>) -> Result<Self> {
        let exact = |notes| Self { precision: Precision::Exact, arithmetic: Arithmetic::EXACT, notes };
        let limits = device.limits();
        let wanted = precision.unwrap_or(Precision::best(limits));
        if wanted == Precision::Exact {
            return Ok(exact(Vec::new()));
        }
        let arithmetic = Arithmetic::of(wanted, limits).ok_or_else(|| lacking(wanted, limits))?;
        let test = SelfTest::of(device)?;
        let failed = test.deviations.iter().filter(|(_, deviation)| !passes(**deviation));
        let note = |(kernel, deviation): (&String, &Option<f64>)| match deviation {
            Some(times) => format!("{kernel} deviates {times:.1} times what it may on {}: not used", limits.name),
            None if kernel == UNFINISHED => unfinished(device),
            None => format!("{kernel} gave no result on {}: not used", limits.name),
        };
        let notes: Vec<_> = failed.map(note).collect();
        let Some(arithmetic) = test.allowed(arithmetic) else {
            let found = format!("{}, which failed its self-test ({})", wanted.name(), notes.join("; "));
            return if precision.is_some() { Err(refused(found, limits)) } else { Ok(exact(notes)) };
        };
        let arithmetic = Tuning::known(device).unwrap_or_default().applied(arithmetic, limits);
        Ok(Self { precision: wanted, arithmetic, notes })
    }
}

fn lacking(precision: Precision, limits: &Limits) -> Error {
    let what = match precision {
        Precision::Turbo if limits.half_storage => "matrix units for 8-bit integers",
        _ => "16-bit floats in buffers",
    };
    refused(format!("{}, without {what}", precision.name()), limits)
}

fn refused(found: String, limits: &Limits) -> Error {
    Error::argument("precision", found, format!("exact on {}", limits.name))
}
