#![no_main]
//! COLMAP points as binary.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::points("points3D.bin", bytes));
