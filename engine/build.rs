//! Compiles `kernels/**/*.comp` to SPIR-V and generates the typed kernel table. SPIR-V is committed
//! in `kernels/spirv/` with source hashes, so builds need no shaderc.

#[path = "build/codegen.rs"]
mod codegen;
#[path = "build/elements.rs"]
mod elements;
#[path = "build/reflect.rs"]
mod reflect;
#[path = "build/sources.rs"]
mod sources;
#[cfg(feature = "compile-kernels")]
#[allow(unsafe_code)]
#[path = "build/validate.rs"]
mod validate;

use std::{env, fs, path::PathBuf};

fn main() {
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("../kernels");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    // Of kernels/reference only the list of areas.
    for watched in sources::folders(&root).iter().filter(|name| !["reference", "verify"].contains(&name.as_str())) {
        println!("cargo:rerun-if-changed={}", root.join(watched).display());
    }
    println!("cargo:rerun-if-changed={}", root.join("reference/lib.rs").display());
    println!("cargo:rerun-if-env-changed=ZIPSPLAT_RECOMPILE_KERNELS");

    let kernels = sources::find(&root);
    sources::refresh(&root, &kernels);
    let modules: Vec<_> = kernels
        .iter()
        .map(|kernel| {
            let words = fs::read(root.join("spirv").join(format!("{}.spv", kernel.name))).expect("refreshed above");
            (kernel, reflect::reflect(&kernel.name, &words))
        })
        .collect();
    let limits = fs::read_to_string(root.join("shared/limits.glsl")).expect("kernels/shared/limits.glsl");
    fs::write(out.join("kernels.rs"), codegen::table(&root, &modules, &limits)).expect("OUT_DIR is writable");
}
