//! Versions of the header and of the library.

use std::ffi::{CStr, c_char};

pub const ZS_VERSION_MAJOR: u32 = 0;
pub const ZS_VERSION_MINOR: u32 = 2;
pub const ZS_VERSION_PATCH: u32 = 0;
pub const ZS_ABI_VERSION: u32 = 2;

const VERSION: &CStr = match CStr::from_bytes_with_nul(concat!(env!("CARGO_PKG_VERSION"), "\0").as_bytes()) {
    Ok(version) => version,
    Err(_) => panic!("a version has no NUL"),
};

#[unsafe(no_mangle)]
pub extern "C" fn zs_abi_version() -> u32 {
    ZS_ABI_VERSION
}

#[unsafe(no_mangle)]
pub extern "C" fn zs_version() -> *const c_char {
    VERSION.as_ptr()
}
