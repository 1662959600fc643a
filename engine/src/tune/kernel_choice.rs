use super::{SelfTest, Tuning};
use crate::{
    Error, Result,
    gpu::{Device, Limits},
    ops::{Arithmetic, Precision},
};
use std::ops::ControlFlow;

/// A precision's arithmetic on a device.
#[derive(Clone, Debug)]
pub struct KernelChoice {
    pub precision: Precision,
    pub arithmetic: Arithmetic,
    /// Failed kernels, for the user.
    pub warnings: Vec<String>,
}

impl KernelChoice {
    /// Returns the arithmetic of a precision, by default the best.
    ///
    /// # Errors
    /// [`Error::Argument`] if unsupported; device failures.
    pub fn of(device: &Device, precision: Option<Precision>) -> Result<Self> {
        Self::of_with(device, precision, |_, _| ControlFlow::Continue(()))
    }

    /// [`KernelChoice::of`], with progress of the first self-test.
    pub fn of_with(
        device: &Device,
        precision: Option<Precision>,
        progress: impl FnMut(&str, f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let limits = device.limits();
        let exact = |warnings| Self { precision: Precision::Fp32, arithmetic: Self::exact(device), warnings };
        let wanted = precision.unwrap_or(Precision::best(limits));
        if wanted == Precision::Fp32 {
            return Ok(exact(Vec::new()));
        }
        let arithmetic = Arithmetic::of(wanted, limits).ok_or_else(|| lacking(wanted, limits))?;
        let test = SelfTest::of(device, arithmetic, progress)?;
        let warnings = test.notes(device, arithmetic);
        let Some(arithmetic) = test.allowed(arithmetic) else {
            let found = format!("{}, which failed its self-test ({})", wanted.name(), warnings.join("; "));
            return if precision.is_some() { Err(refused(found, limits)) } else { Ok(exact(warnings)) };
        };
        Ok(Self { precision: wanted, arithmetic: tuned(device, arithmetic), warnings })
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
        Precision::Int8 if limits.half_storage => "matrix units or dot products for 8-bit integers",
        _ => "16-bit floats in buffers",
    };
    refused(format!("{}, without {what}", precision.name()), limits)
}

fn refused(found: String, limits: &Limits) -> Error {
    Error::argument("precision", found, format!("{} on {}", Precision::Fp32.name(), limits.name))
}
