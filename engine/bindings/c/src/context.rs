//! Devices and contexts.

use super::{
    pointers::{
        POINTER, Versioned, borrow, destroy, optional_text, produce, read_versioned, write_defaults, write_versioned,
    },
    status::{Failure, guard, zs_status},
};
use std::ffi::c_char;
use zipsplat::gpu::{Device, DeviceInfo, DeviceOptions, Limits, list_devices};

/// A Vulkan device at work: everything that runs on it is created from a context. Any number of threads may use a context at
/// the same time. Models and renderers keep what they need of it: it may be destroyed before them.
pub struct zs_context {
    pub(super) device: Device,
    /// Whether the device is the app's.
    pub(super) adopted: bool,
}

/// Kinds of devices.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_device_kind {
    /// Integrated in the processor, virtual, or unknown.
    ZS_DEVICE_OTHER = 0,
    /// A graphics card.
    ZS_DEVICE_DISCRETE = 1,
    /// The processor itself, by way of lavapipe.
    ZS_DEVICE_CPU = 2,
}

/// A device. Strings are UTF-8, end with NUL and are cut where they are too long.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_device_info {
    /// sizeof(zs_device_info); set it before the call.
    pub struct_size: u32,
    /// Number of the device, as zs_context_options.device takes it; 0 for an adopted device.
    pub index: u32,
    /// 1 where the engine can use the device, else 0.
    pub usable: u32,
    /// Kind of the device.
    pub kind: zs_device_kind_value,
    /// Bytes of the memory that kernels work in.
    pub memory_bytes: u64,
    /// The device's name.
    pub name: [c_char; 256],
    /// The driver's name and version.
    pub driver: [c_char; 256],
    /// Reasons why the device is not usable; "" where it is.
    pub missing: [c_char; 512],
    /// UUID of the device, 32 hexadecimal digits: those that CUDA and nvidia-smi have for it.
    pub uuid: [c_char; 40],
}

/// In structures an enumeration is its number, so that a wrong one can be refused. cbindgen names it as the enumeration.
pub(super) type zs_device_kind_value = i32;

/// Options of opening a device.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_context_options {
    /// sizeof(zs_context_options); zs_context_options_default sets it.
    pub struct_size: u32,
    /// 1 to run under the Khronos validation layer with synchronisation validation, whose messages make calls fail with
    /// ZS_ERROR_DRIVER: for development. Default 0, or 1 where the environment variable ZIPSPLAT_VALIDATION is 1.
    pub validation: u32,
    /// Uses at most so many bytes of the device's memory and leaves the rest to others: what needs more fails with
    /// ZS_ERROR_OUT_OF_MEMORY before anything runs. Default 0: all that there is.
    pub max_memory_bytes: u64,
    /// A device's number ("0"; digits are nothing else), a part of its name ("nvidia"), or its
    /// UUID, with or without GPU- and hyphens; NULL for the best. Default NULL.
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

// SAFETY: repr(C), two u32, a u64 and a pointer: no padding but at the end, where pointers have 4 bytes.
unsafe impl Versioned for zs_context_options {
    const NAME: &str = "zs_context_options";
    const FIRST_SIZE: usize = 16 + POINTER;
    fn defaults() -> Self {
        let validation = DeviceOptions::default().validation.into();
        Self { struct_size: size_of::<Self>() as u32, validation, max_memory_bytes: 0, device: std::ptr::null() }
    }
}

/// Counts the Vulkan devices of this machine, usable or not. ZS_ERROR_NO_DEVICE where there is no Vulkan loader or no
/// driver.
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

/// Says what device number `index` is, from 0 to below zs_device_count.
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

/// Fills `options` with the defaults. `size` is sizeof(zs_context_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_options_default(options: *mut zs_context_options, size: usize) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Opens a device of its own: instance, device and queue are the context's. `options` may be NULL.
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
        let options = DeviceOptions { selector, validation, max_memory_bytes, ..DeviceOptions::default() };
        Ok(zs_context { device: Device::open(&options)?, adopted: false })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(context, open) }
}

/// Says what device a context is on.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_get_info(context: *const zs_context, info: *mut zs_device_info) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let device = &unsafe { borrow(context, "context") }?.device;
        let (index, limits) = (device.index(), device.limits().clone());
        // SAFETY: the caller's structure.
        unsafe { write_versioned(info, describe(&DeviceInfo { index, missing: Vec::new(), limits })) }
    })
}

/// Destroys a context. Its device closes when its last model and renderer are gone too. NULL is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_context_destroy(context: *mut zs_context) {
    // SAFETY: an object that the caller gives up, or NULL.
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
        usable: device.missing.is_empty().into(),
        kind: kind as i32,
        memory_bytes: *memory_bytes,
        name: fixed(name),
        driver: fixed(driver),
        missing: fixed(&device.missing.join(", ")),
        uuid: fixed(device.limits.uuid()),
        ..zs_device_info::defaults()
    }
}

/// Text of at most `N - 1` bytes, cut between characters, and NUL up to the end.
fn fixed<const N: usize>(text: &str) -> [c_char; N] {
    let end = (0..N).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0).min(text.len());
    let mut out = [0; N];
    out.iter_mut().zip(&text.as_bytes()[..end]).for_each(|(to, from)| *to = *from as c_char);
    out
}
