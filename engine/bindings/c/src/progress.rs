//! Progress.

use super::pointers::Versioned;
use std::{
    ffi::{CString, c_char, c_void},
    ops::ControlFlow,
};

/// Answers of a progress callback.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_progress_action {
    /// Continues.
    ZS_CONTINUE = 0,
    /// Ends a refinement early and keeps the best scene so far. Other calls are canceled.
    ZS_STOP = 1,
    /// Cancels the call, which fails with ZS_ERROR_CANCELLED.
    ZS_CANCEL = 2,
}

pub(super) type zs_progress_action_value = i32;

/// Progress of a call. Refinements also set the fields from `step` on; others leave them 0.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_progress {
    /// Size of this structure in the library's version.
    pub struct_size: u32,
    /// 0.
    pub reserved: u32,
    /// Completed fraction of the call, from 0 to 1.
    pub fraction: f64,
    /// Name of the current stage, for a log; valid during the callback.
    pub stage: *const c_char,
    /// Completed steps.
    pub step: usize,
    /// Total steps.
    pub steps: usize,
    /// Mean loss of the last step.
    pub loss: f64,
    /// Latest PSNR in dB of the held-out photos; NaN without any.
    pub psnr: f64,
    /// Estimated seconds left.
    pub eta_seconds: f64,
}

versioned!(zs_progress);

/// Progress callback. `progress` is valid during the callback. It may call zs_ functions, but not
/// on the call's own objects. Unknown answers cancel.
pub type zs_progress_callback =
    Option<unsafe extern "C" fn(user_data: *mut c_void, progress: *const zs_progress) -> zs_progress_action_value>;

/// A callback with its argument.
#[derive(Clone, Copy)]
pub(super) struct Reporter {
    pub callback: zs_progress_callback,
    pub user_data: *mut c_void,
}

impl Reporter {
    /// Returns the answer to `progress`.
    pub(super) fn report(self, stage: &str, progress: zs_progress) -> zs_progress_action {
        let Some(callback) = self.callback else { return zs_progress_action::ZS_CONTINUE };
        let stage = CString::new(stage).unwrap_or_default();
        let progress = zs_progress { stage: stage.as_ptr(), ..progress };
        // SAFETY: the caller's function, with the caller's data.
        match unsafe { callback(self.user_data, &progress) } {
            0 => zs_progress_action::ZS_CONTINUE,
            1 => zs_progress_action::ZS_STOP,
            _ => zs_progress_action::ZS_CANCEL,
        }
    }

    /// Reports a call without a partial result.
    pub(super) fn fraction(self, stage: &str, fraction: f64) -> ControlFlow<()> {
        match self.report(stage, zs_progress { fraction, ..Versioned::new() }) {
            zs_progress_action::ZS_CONTINUE => ControlFlow::Continue(()),
            _ => ControlFlow::Break(()),
        }
    }
}
