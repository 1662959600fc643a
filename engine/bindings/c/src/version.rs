//! Versions of the header and of the library.

use std::ffi::{CStr, c_char};

/// Version of this header's library: fixes raise the patch number, additions the minor one.
pub const ZS_VERSION_MAJOR: u32 = 0;
/// See ZS_VERSION_MAJOR.
pub const ZS_VERSION_MINOR: u32 = 2;
/// See ZS_VERSION_MAJOR.
pub const ZS_VERSION_PATCH: u32 = 0;
/// ABI version, also in the shared library's file name. Incompatible changes raise it.
pub const ZS_ABI_VERSION: u32 = 2;

const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("a version has no NUL"),
};

/// Returns the library's ABI version. If it is not ZS_ABI_VERSION, call nothing else.
#[unsafe(no_mangle)]
pub extern "C" fn zs_abi_version() -> u32 {
    ZS_ABI_VERSION
}

/// Returns the library's version, as "0.2.0".
#[unsafe(no_mangle)]
pub extern "C" fn zs_version() -> *const c_char {
    VERSION.as_ptr()
}
