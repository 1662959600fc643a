//! Devices and contexts.

use super::{
    pointers::{
        POINTER, Versioned, borrow, destroy, optional_text, produce, read_versioned, write_defaults, write_versioned,
    },
    status::{Failure, guard, zs_status},
};
use std::ffi::c_char;
use zipsplat::gpu::{Device, DeviceInfo, DeviceOptions, Limits, list_devices};

/// An open Vulkan device.
pub struct zs_context {
    pub(super) device: Device,
    pub(super) adopted: bool,
}

/// Kinds of devices.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_device_kind {
    /// Integrated, virtual or unknown.
    ZS_DEVICE_OTHER = 0,
    /// Discrete GPU.
    ZS_DEVICE_DISCRETE = 1,
    /// CPU (lavapipe).
    ZS_DEVICE_CPU = 2,
}

/// Description of a device; strings are NUL-terminated and truncated to fit.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_device_info {
    /// sizeof(zs_device_info).
    pub struct_size: u32,
    /// Device number for zs_context_options.device; 0 if adopted.
    pub index: u32,
    /// 1 if the engine can use the device.
    pub usable: u32,
    /// Kind.
    pub kind: zs_device_kind_value,
    /// Device-local memory.
    pub memory_bytes: u64,
    /// Name.
    pub name: [c_char; 256],
    /// Driver name and version.
    pub driver: [c_char; 256],
    /// Missing requirements; "" if usable.
    pub missing: [c_char; 512],
    /// UUID as 32 hexadecimal digits, as in nvidia-smi.
    pub uuid: [c_char; 40],
}

/// An enumeration's number in structures, so that invalid values can be rejected.
pub(super) type zs_device_kind_value = i32;

/// Options of zs_context_create.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_context_options {
    /// sizeof(zs_context_options).
    pub struct_size: u32,
    /// 1 enables the Khronos validation layer, whose messages fail calls with ZS_ERROR_DRIVER.
    /// Default 1 if the environment variable ZIPSPLAT_VALIDATION is 1, else 0.
    pub validation: u32,
    /// Device memory budget; 0 is unlimited. Work beyond it fails with ZS_ERROR_OUT_OF_MEMORY
    /// before submission.
    pub max_memory_bytes: u64,
    /// Device number, part of its name, or UUID with or without "GPU-" and hyphens. NULL selects
    /// the best device.
    pub device: *const c_char,
}

// SAFETY: repr(C), two u32, a u64 and text: no padding.
unsafe impl Versioned for zs_device_info {
    const NAME: &str = "zs_device_info";
    const FIRST_SIZE: usize = 1048;
    fn defaults() -> Self {
        Self {
            struct_size: size_of::<Self>() as u32,
            index: 0,
            usable: 0,
            kind: 0,
            memory_bytes: 0,
            name: [0; 256],
            driver: [0; 256],
            missing: [0; 512],
            uuid: [0; 40],
        }
    }
}

// SAFETY: repr(C), two u32, a u64 and a pointer: padding only at the end for 4-byte pointers.
unsafe impl Versioned for zs_context_options {
    const NAME: &str = "zs_context_options";
    const FIRST_SIZE: usize = 16 + POINTER;
    fn defaults() -> Self {
        let validation = DeviceOptions::default().validation.into();
        Self { struct_size: size_of::<Self>() as u32, validation, max_memory_bytes: 0, device: std::ptr::null() }
    }
}

/// Counts Vulkan devices, usable or not; ZS_ERROR_NO_DEVICE without a loader or driver.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_count(count: *mut u32) -> zs_status {
    guard(|| {
        if count.is_null() {
            return Err(Failure::argument("count", "NULL", "where to put it"));
        }
        // SAFETY: not NULL, and the caller's to write.
        unsafe { count.write(0) };
        let found = list_devices()?.len() as u32;
        // SAFETY: as above.
        unsafe { count.write(found) };
        Ok(())
    })
}

/// Describes device `index`, less than zs_device_count.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_get(index: u32, info: *mut zs_device_info) -> zs_status {
    guard(|| {
        let devices = list_devices()?;
        let found = devices.get(index as usize);
        let found =
            found.ok_or_else(|| Failure::argument("device", index, format!("a number below {}", devices.len())))?;
        // SAFETY: the caller's structure.
        unsafe { write_versioned(info, describe(found)) }
    })
}

/// Sets defaults.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_options_default(options: *mut zs_context_options, size: usize) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Opens a device with its own instance and queue.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_create(
    options: *const zs_context_options,
    context: *mut *mut zs_context,
) -> zs_status {
    let open = || {
        // SAFETY: the caller's structure, or NULL.
        let options = unsafe { read_versioned(options) }?;
        // SAFETY: a string or NULL, as the header says.
        let selector = unsafe { optional_text(options.device, "device") }?.map(str::to_owned);
        let validation = options.validation != 0;
        let max_memory_bytes = Some(options.max_memory_bytes).filter(|bytes| *bytes > 0);
        let options = DeviceOptions { device: selector, validation, max_memory_bytes, ..DeviceOptions::default() };
        Ok(zs_context { device: Device::open(&options)?, adopted: false })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(context, open) }
}

/// Describes the context's device.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_get_info(context: *const zs_context, info: *mut zs_device_info) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let device = &unsafe { borrow(context, "context") }?.device;
        let (index, limits) = (device.index(), device.limits().clone());
        // SAFETY: the caller's structure.
        unsafe { write_versioned(info, describe(&DeviceInfo { index, unusable_reason: Vec::new(), limits })) }
    })
}

/// Destroys a context; its device closes with its last model and renderer.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_destroy(context: *mut zs_context) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(context) }
}

fn describe(device: &DeviceInfo) -> zs_device_info {
    let Limits { name, driver, cpu, discrete, memory_bytes, .. } = &device.limits;
    let kind = match (cpu, discrete) {
        (true, _) => zs_device_kind::ZS_DEVICE_CPU,
        (_, true) => zs_device_kind::ZS_DEVICE_DISCRETE,
        _ => zs_device_kind::ZS_DEVICE_OTHER,
    };
    zs_device_info {
        index: device.index as u32,
        usable: device.unusable_reason.is_empty().into(),
        kind: kind as i32,
        memory_bytes: *memory_bytes,
        name: fixed(name),
        driver: fixed(driver),
        missing: fixed(&device.unusable_reason.join(", ")),
        uuid: fixed(device.limits.uuid()),
        ..zs_device_info::defaults()
    }
}

/// Truncates text to `N - 1` bytes at a character boundary and pads it with NUL.
fn fixed<const N: usize>(text: &str) -> [c_char; N] {
    let end = (0..N).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0).min(text.len());
    let mut out = [0; N];
    out.iter_mut().zip(&text.as_bytes()[..end]).for_each(|(to, from)| *to = *from as c_char);
    out
}
