#![no_main]
//! SPZ scenes, with their gzip stream.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::scene("spz", bytes));
