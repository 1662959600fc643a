use std::sync::OnceLock;
use zipsplat::gpu::{Device, DeviceOptions};

/// Validated if `ZIPSPLAT_VALIDATION` is 1.
pub fn device() -> &'static Device {
    static DEVICE: OnceLock<Device> = OnceLock::new();
    DEVICE.get_or_init(|| Device::open(&DeviceOptions::default()).expect("a Vulkan device; tools/test.sh brings one"))
}
