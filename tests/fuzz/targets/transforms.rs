#![no_main]
//! Cameras of instant-ngp and nerfstudio.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::transforms(bytes));
