//! The version that the header was made for, and that of the library.

use std::ffi::{CStr, c_char};

/// Version of the library that this header belongs to. Fixes of bugs raise the last number, additions the middle one.
pub const ZS_VERSION_MAJOR: u32 = 0;
/// See ZS_VERSION_MAJOR.
pub const ZS_VERSION_MINOR: u32 = 1;
/// See ZS_VERSION_MAJOR.
pub const ZS_VERSION_PATCH: u32 = 0;
/// Version of the ABI. It rises when something here changes its meaning, size or place, and the shared library's file name
/// with it; additions keep it.
pub const ZS_ABI_VERSION: u32 = 1;

const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("a version has no NUL"),
};

/// The ABI version of the library that is loaded. Where it is not ZS_ABI_VERSION, call nothing else.
#[unsafe(no_mangle)]
pub extern "C" fn zs_abi_version() -> u32 {
    ZS_ABI_VERSION
}

/// The version of the library that is loaded, as "0.1.0". Static: never free it.
#[unsafe(no_mangle)]
pub extern "C" fn zs_version() -> *const c_char {
    VERSION.as_ptr()
}
