//! The device that tests run on.

use std::sync::OnceLock;
use zipsplat::gpu::{Device, DeviceOptions};

static DEVICE: OnceLock<Device> = OnceLock::new();

/// One device for all tests of a process, under validation where `ZIPSPLAT_VALIDATION` is 1.
pub fn device() -> &'static Device {
    DEVICE.get_or_init(|| {
        let device = Device::open(&DeviceOptions::default()).expect("a Vulkan device; tools/test.sh brings one");
        #[allow(unsafe_code)]
        // SAFETY: a C function, and a handler that may run at any time behind the last test.
        unsafe {
            atexit(close);
        }
        device
    })
}

#[allow(unsafe_code)]
unsafe extern "C" {
    fn atexit(handler: extern "C" fn()) -> i32;
}

/// A validation layer that watches shaders does not survive the end of a process that has a device open.
#[allow(unsafe_code)]
extern "C" fn close() {
    if let Some(device) = DEVICE.get() {
        // SAFETY: all tests have ended, and nobody asks for the device again.
        unsafe { std::ptr::drop_in_place(std::ptr::from_ref(device).cast_mut()) };
    }
}
