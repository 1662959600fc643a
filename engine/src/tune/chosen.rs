//! Arithmetic without kernels that failed their self-test.

use super::{SelfTest, Tuning};
use crate::{
    Error, Result,
    gpu::{Device, Limits},
    ops::{Arithmetic, Precision},
};
use std::ops::ControlFlow;

/// A precision's arithmetic on a device.
#[derive(Clone, Debug)]
pub struct Chosen {
    /// Precision.
    pub precision: Precision,
    /// Arithmetic.
    pub arithmetic: Arithmetic,
    /// Failed kernels, for the user.
    pub notes: Vec<String>,
}

impl Chosen {
    /// Returns the arithmetic of a precision, by default the best.
    ///
    /// # Errors
    /// [`Error::Argument`] if unsupported; device failures.
    pub fn of(device: &Device, precision: Option<Precision>) -> Result<Self> {
        Self::of_with(device, precision, |_, _| ControlFlow::Continue(()))
    }

    /// [`Chosen::of`], with progress of the first self-test.
    pub fn of_with(
        device: &Device,
        precision: Option<Precision>,
        progress: impl FnMut(&str, f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let limits = device.limits();
        let exact = |notes| Self { precision: Precision::Exact, arithmetic: Self::exact(device), notes };
        let wanted = precision.unwrap_or(Precision::best(limits));
        if wanted == Precision::Exact {
            return Ok(exact(Vec::new()));
        }
        let arithmetic = Arithmetic::of(wanted, limits).ok_or_else(|| lacking(wanted, limits))?;
        let test = SelfTest::of(device, arithmetic, progress)?;
        let notes = test.notes(device);
        let Some(arithmetic) = test.allowed(arithmetic) else {
            let found = format!("{}, which failed its self-test ({})", wanted.name(), notes.join("; "));
            return if precision.is_some() { Err(refused(found, limits)) } else { Ok(exact(notes)) };
        };
        Ok(Self { precision: wanted, arithmetic: tuned(device, arithmetic), notes })
    }

    /// Returns the f32 arithmetic, which needs no test.
    pub fn exact(device: &Device) -> Arithmetic {
        tuned(device, Arithmetic::EXACT)
    }
}

fn tuned(device: &Device, arithmetic: Arithmetic) -> Arithmetic {
    Tuning::known(device).unwrap_or_default().applied(arithmetic, device.limits())
}

fn lacking(precision: Precision, limits: &Limits) -> Error {
    let what = match precision {
        Precision::Turbo if limits.half_storage => "matrix units or dot products for 8-bit integers",
        _ => "16-bit floats in buffers",
    };
    refused(format!("{}, without {what}", precision.name()), limits)
}

fn refused(found: String, limits: &Limits) -> Error {
    Error::argument("precision", found, format!("exact on {}", limits.name))
}
