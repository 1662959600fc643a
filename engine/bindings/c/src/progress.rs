//! Progress.

use super::pointers::{Versioned, c_text};
use std::{
    ffi::{c_char, c_void},
    ops::ControlFlow,
};

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_progress_action {
    ZS_CONTINUE = 0,
    ZS_STOP = 1,
    ZS_CANCEL = 2,
}

pub(super) type zs_progress_action_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_progress {
    pub struct_size: u32,
    pub reserved: u32,
    pub fraction: f64,
    pub stage: *const c_char,
    pub step: usize,
    pub steps: usize,
    pub loss: f64,
    pub psnr: f64,
    pub eta_seconds: f64,
}

versioned!(zs_progress { reserved });

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
        let stage = c_text(stage);
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
