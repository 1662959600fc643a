use std::sync::{
    OnceLock,
    atomic::{AtomicUsize, Ordering},
};
use zipsplat::gpu::{Device, DeviceOptions};

/// One of two devices, the same for a thread: lavapipe compiles a device's kernels one at a time.
/// Validated if `ZIPSPLAT_VALIDATION` is 1.
pub fn device() -> &'static Device {
    static DEVICES: [OnceLock<Device>; 2] = [OnceLock::new(), OnceLock::new()];
    static THREADS: AtomicUsize = AtomicUsize::new(0);
    thread_local! {
        static THREAD: usize = THREADS.fetch_add(1, Ordering::Relaxed);
    }
    DEVICES[THREAD.with(|thread| thread % 2)]
        .get_or_init(|| Device::open(&DeviceOptions::default()).expect("a Vulkan device; tools/test.sh brings one"))
}
