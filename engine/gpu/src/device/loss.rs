use super::{Shared, failure::driver};
use crate::{Error, Result};
use ash::vk;
use std::sync::atomic::Ordering;

impl Shared {
    pub fn failed(&self, call: &'static str, result: vk::Result) -> Error {
        if result == vk::Result::ERROR_DEVICE_LOST {
            self.lost.store(true, Ordering::Relaxed);
        }
        driver(call, result)
    }

    /// Drivers may answer later calls with success or unrelated errors.
    pub fn check_lost(&self) -> Result<()> {
        if self.lost.load(Ordering::Relaxed) { Err(Error::DeviceLost) } else { Ok(()) }
    }
}
