use super::Shared;
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

pub(crate) fn driver(call: &'static str, result: vk::Result) -> Error {
    match result {
        vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost,
        result => Error::Driver { call, result: result.to_string() },
    }
}

/// Returns true if a submission may be in flight. So may one that loses the device (specification,
/// "Lost Device"): wait before destroying its resources.
pub(crate) fn is_in_flight<T>(submitted: &Result<T>) -> bool {
    matches!(submitted, Ok(_) | Err(Error::DeviceLost))
}
