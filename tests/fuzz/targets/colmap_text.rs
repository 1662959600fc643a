#![no_main]
//! COLMAP models as text.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::colmap("txt", bytes));
