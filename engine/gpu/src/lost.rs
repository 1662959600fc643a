//! Devices that are lost: once one is, it stays so, and every call that works with it says so.

use super::{device::Shared, failure::driver};
use crate::{Error, Result};
use ash::vk;
use std::sync::atomic::Ordering;

impl Shared {
    /// The error of a call that failed; one that the device was lost in is remembered.
    pub fn failed(&self, call: &'static str, result: vk::Result) -> Error {
        if result == vk::Result::ERROR_DEVICE_LOST {
            self.lost.store(true, Ordering::Relaxed);
        }
        driver(call, result)
    }

    /// Fails where the device was lost before. Mapped memory could still be read and written then, and drivers answer some
    /// calls with success or with other errors.
    ///
    /// # Errors
    /// [`Error::DeviceLost`].
    pub fn check_lost(&self) -> Result<()> {
        if self.lost.load(Ordering::Relaxed) { Err(Error::DeviceLost) } else { Ok(()) }
    }
}
