//! The device that tests run on.

use std::sync::OnceLock;
use zipsplat::gpu::{Device, DeviceOptions};

/// One device for all tests of a process, under validation where `ZIPSPLAT_VALIDATION` is 1.
pub fn device() -> &'static Device {
    static DEVICE: OnceLock<Device> = OnceLock::new();
    DEVICE.get_or_init(|| Device::open(&DeviceOptions::default()).expect("a Vulkan device; tools/test.sh brings one"))
}
