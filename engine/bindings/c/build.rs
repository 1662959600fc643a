//! Names the shared library by its ABI version, so that no program loads one with another ABI.

use std::{env, fs};

fn main() {
    let source = "src/version.rs";
    println!("cargo:rerun-if-changed={source}");
    let text = fs::read_to_string(source).expect("the version of the ABI");
    let version = text.split("pub const ZS_ABI_VERSION: u32 = ").nth(1);
    let version = version.and_then(|rest| rest.split(';').next()).expect("src/version.rs states ZS_ABI_VERSION");
    match env::var("CARGO_CFG_TARGET_OS").as_deref() {
        Ok("linux" | "android" | "freebsd") => {
            println!("cargo:rustc-cdylib-link-arg=-Wl,-soname,libzipsplat.so.{version}");
        }
        Ok("macos" | "ios") => {
            println!("cargo:rustc-cdylib-link-arg=-Wl,-install_name,@rpath/libzipsplat.{version}.dylib");
        }
        _ => {}
    }
}
