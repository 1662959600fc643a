#![no_main]
//! glTF scenes as text.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::scene("gltf", bytes));
