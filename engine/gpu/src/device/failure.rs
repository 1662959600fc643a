use crate::{Error, Result};
use ash::vk;

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
