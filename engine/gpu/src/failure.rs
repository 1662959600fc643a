//! The error that a failed call of Vulkan means.

use crate::{Error, Result};
use ash::vk;

/// The error for a failed call.
pub(super) fn driver(call: &'static str, result: vk::Result) -> Error {
    match result {
        vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost,
        result => Error::Driver { call, result: result.to_string() },
    }
}

/// True where a submission counts as under way. The specification counts it so where the device is lost, too ("Lost Device"):
/// it has to be waited for, which ends with the same error, before anything that it uses is destroyed.
pub(super) fn is_under_way<T>(submitted: &Result<T>) -> bool {
    matches!(submitted, Ok(_) | Err(Error::DeviceLost))
}
