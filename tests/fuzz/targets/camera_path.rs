#![no_main]
//! Camera paths of nerfstudio and lists of matrices.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::camera_path(bytes));
