//! Devices.

use super::{
    pointers::{Versioned, borrow, destroy, optional_text, produce, put, read_versioned, write_versioned},
    status::{Failure, guard, zs_status},
};
use std::{ffi::c_char, path::PathBuf};
use zipsplat::gpu::{Device, DeviceInfo, DeviceOptions, Limits, cache_dir, list_devices};

pub struct zs_device {
    pub(super) gpu: Device,
    pub(super) adopted: bool,
}

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_device_kind {
    ZS_DEVICE_OTHER = 0,
    ZS_DEVICE_DISCRETE = 1,
    ZS_DEVICE_INTEGRATED = 2,
    ZS_DEVICE_CPU = 3,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_device_info {
    pub struct_size: u32,
    pub index: u32,
    pub usable: u32,
    pub kind: zs_device_kind_value,
    pub memory_bytes: u64,
    pub name: [c_char; 256],
    pub driver: [c_char; 256],
    pub unusable_reason: [c_char; 512],
    pub uuid: [c_char; 40],
}

/// Plain integer of a structure's field, which may hold invalid values.
pub(super) type zs_device_kind_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_device_options {
    pub struct_size: u32,
    pub validation: u32,
    pub max_memory_bytes: u64,
    pub device: *const c_char,
    pub cache_dir: *const c_char,
}

versioned!(zs_device_info, zs_device_options);

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_count(count: *mut usize) -> zs_status {
    guard(|| {
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(count, 0, "count") }?;
        let found = list_devices()?.len();
        // SAFETY: as above.
        unsafe { put(count, found, "count") }
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_get(index: usize, info: *mut zs_device_info) -> zs_status {
    guard(|| {
        let devices = list_devices()?;
        let found = devices.get(index);
        let found =
            found.ok_or_else(|| Failure::argument("device", index, format!("a number below {}", devices.len())))?;
        // SAFETY: the caller's structure.
        unsafe { write_versioned(info, describe(found)) }
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_create(options: *const zs_device_options, device: *mut *mut zs_device) -> zs_status {
    let open = || {
        // SAFETY: the caller's arguments.
        let options = unsafe { read_versioned(options) }?;
        // SAFETY: the caller's arguments.
        let (device, cache_dir) = unsafe { (optional_text(options.device, "device")?, cached_in(options.cache_dir)?) };
        let max_memory_bytes = Some(options.max_memory_bytes).filter(|bytes| *bytes > 0);
        let default = DeviceOptions::default();
        let validation = options.validation != 0 || default.validation;
        let device = device.map(str::to_owned);
        let options = DeviceOptions { device, validation, max_memory_bytes, cache_dir, ..default };
        Ok(zs_device { gpu: Device::open(&options)?, adopted: false })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(device, open) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_get_info(device: *const zs_device, info: *mut zs_device_info) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let gpu = &unsafe { borrow(device, "device") }?.gpu;
        let (index, limits) = (gpu.index(), gpu.limits().clone());
        // SAFETY: the caller's structure.
        unsafe { write_versioned(info, describe(&DeviceInfo { index, unusable_reason: Vec::new(), limits })) }
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_destroy(device: *mut zs_device) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(device) }
}

/// # Safety
/// `pointer` is NULL or a NUL-terminated string.
pub(super) unsafe fn cached_in(pointer: *const c_char) -> Result<Option<PathBuf>, Failure> {
    // SAFETY: the caller's promise.
    Ok(match unsafe { optional_text(pointer, "cache_dir") }? {
        None => cache_dir(),
        Some(folder) => (!folder.is_empty()).then(|| folder.into()),
    })
}

fn describe(device: &DeviceInfo) -> zs_device_info {
    let Limits { name, driver, cpu, discrete, integrated, memory_bytes, .. } = &device.limits;
    let kind = match (cpu, discrete, integrated) {
        (true, ..) => zs_device_kind::ZS_DEVICE_CPU,
        (_, true, _) => zs_device_kind::ZS_DEVICE_DISCRETE,
        (.., true) => zs_device_kind::ZS_DEVICE_INTEGRATED,
        _ => zs_device_kind::ZS_DEVICE_OTHER,
    };
    zs_device_info {
        index: device.index as u32,
        usable: device.unusable_reason.is_empty().into(),
        kind: kind as i32,
        memory_bytes: *memory_bytes,
        name: fixed(name),
        driver: fixed(driver),
        unusable_reason: fixed(&device.unusable_reason.join(", ")),
        uuid: fixed(device.limits.uuid()),
        ..zs_device_info::new()
    }
}

/// Truncates text to `N - 1` bytes at a character boundary and pads it with NUL.
fn fixed<const N: usize>(text: &str) -> [c_char; N] {
    let end = (0..N).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0).min(text.len());
    let mut out = [0; N];
    out.iter_mut().zip(&text.as_bytes()[..end]).for_each(|(to, from)| *to = *from as c_char);
    out
}
