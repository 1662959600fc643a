#![no_main]
//! The inside of an SPZ's gzip stream.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::scene("spz", &zipsplat_fuzz::deflated(bytes)));
