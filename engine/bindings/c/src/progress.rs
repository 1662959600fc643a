//! Progress.

use super::pointers::Versioned;
use std::{
    ffi::{CString, c_char, c_void},
    ops::ControlFlow,
};

/// Answer of a progress callback.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_progress_action {
    /// Continues.
    ZS_CONTINUE = 0,
    /// Ends a refinement early with the best scene so far; cancels other calls.
    ZS_STOP = 1,
    /// Cancels: the call fails with ZS_ERROR_CANCELLED.
    ZS_CANCEL = 2,
}

pub(super) type zs_progress_action_value = i32;

/// Progress of a call. Only refinements set the fields from `step` on.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_progress {
    /// Size in the library's version.
    pub struct_size: u32,
    /// 0.
    pub reserved: u32,
    /// Completed fraction of the call, 0 to 1.
    pub fraction: f64,
    /// Name of the current stage.
    pub stage: *const c_char,
    /// Completed steps.
    pub step: usize,
    /// Total steps.
    pub steps: usize,
    /// Mean loss of the last step.
    pub loss: f64,
    /// Latest held-out PSNR in dB, or NaN.
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

    pub(super) fn fraction(self, stage: &str, fraction: f64) -> ControlFlow<()> {
        match self.report(stage, zs_progress { fraction, ..Versioned::new() }) {
            zs_progress_action::ZS_CONTINUE => ControlFlow::Continue(()),
            _ => ControlFlow::Break(()),
        }
    }
}
