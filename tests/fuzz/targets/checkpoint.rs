#![no_main]
//! Checkpoints: safetensors, or archives of torch.save.

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| zipsplat_fuzz::checkpoint(bytes));
