#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::realestate(bytes));
