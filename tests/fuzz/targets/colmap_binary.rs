#![no_main]
//! COLMAP models as binary.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::colmap("bin", bytes));
