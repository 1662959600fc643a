//! A kernel, its verification and its reference share a relative name.

use crate::source::files;
use std::collections::BTreeSet;
use zipsplat::kernels::MODULES;

/// Steps of an operation with another name; variants append a word to its name.
const STEPS: [(&str, &str); 16] = [
    ("features/draw", "features"),
    ("features/gather", "features"),
    ("features/lift", "features"),
    ("loss/dssim", "loss/gradient"),
    ("loss/mask", "loss/gradient"),
    ("loss/moments", "loss/gradient"),
    ("loss/spread", "loss/gradient"),
    ("loss/value", "loss/gradient"),
    ("ops/scan_apply", "ops/sort"),
    ("ops/scan_reduce", "ops/sort"),
    ("ops/key_starts", "ops/sort"),
    ("render/cameras_backward", "render/backward"),
    ("render/color_backward", "render/backward"),
    ("render/project_backward", "render/backward"),
    ("render/rasterize_backward", "render/backward"),
    ("render/tile_counts", "render/intersect"),
];

/// Names without a reference, and their alternative.
const WITHOUT_REFERENCE: [(&str, &str); 2] = [
    ("ops/sort", "the stable sort of the standard library, a running sum"),
    ("render/intersect", "lists made on the host"),
];

fn names(folder: &str, ext: &str) -> BTreeSet<String> {
    let relative = |path: &str| path[folder.len() + 1..].trim_end_matches(&format!(".{ext}")).to_owned();
    files(folder, ext).iter().map(|source| relative(&source.path)).collect()
}

fn verified() -> BTreeSet<String> {
    let cases = names("kernels/verify", "rs").into_iter().map(|name| name.trim_end_matches("/mod").to_owned());
    names("tests/kernels", "rs").into_iter().chain(cases).collect()
}

fn shared_names() -> BTreeSet<String> {
    let verified = verified();
    let shared = |kernel: String| {
        let step = STEPS.iter().find(|(step, _)| *step == kernel).map(|(_, name)| name.to_string());
        let variant =
            || kernel.rsplit_once('_').filter(|(name, _)| !verified.contains(&kernel) && verified.contains(*name));
        step.or_else(|| variant().map(|(name, _)| name.to_owned())).unwrap_or(kernel)
    };
    names("kernels", "comp").into_iter().map(shared).collect()
}

#[test]
fn every_kernel_has_its_verification_and_its_reference() {
    let (verified, references) = (verified(), names("kernels/reference", "rs"));
    let mut missing = Vec::new();
    for name in shared_names() {
        if !verified.contains(&name) {
            missing.push(format!("kernels/verify/{name}.rs or tests/kernels/{name}.rs"));
        }
        let replaced = WITHOUT_REFERENCE.iter().any(|(other, _)| *other == name);
        if replaced == references.contains(&name) {
            missing.push(format!("kernels/reference/{name}.rs (or its exception is out of date)"));
        }
    }
    assert!(missing.is_empty(), "missing: {}", missing.join(", "));
}

#[test]
fn every_test_has_its_kernel() {
    let shared = shared_names();
    let orphans: Vec<String> =
        names("tests/kernels", "rs").into_iter().filter(|name| name.contains('/') && !shared.contains(name)).collect();
    assert!(orphans.is_empty(), "tests of no kernel: {orphans:?}");
}

#[test]
fn every_exception_is_of_use() {
    let kernels = names("kernels", "comp");
    for (kernel, name) in STEPS {
        assert!(kernels.contains(kernel) && kernel != name, "{kernel}");
    }
}

#[test]
fn the_table_has_every_kernel_within_its_limits() {
    // A kernel has one module per element type.
    let types = ["_f32", "_f16", "_bf16", "_i8"];
    fn kernel<'a>(module: &'a str, types: &[&str]) -> &'a str {
        types.iter().find_map(|name| module.strip_suffix(name)).map_or(module, |rest| kernel(rest, types))
    }
    let table: BTreeSet<String> = MODULES.iter().map(|module| kernel(module.name, &types).to_owned()).collect();
    assert_eq!(table, names("kernels", "comp"));
    for module in MODULES {
        assert!(module.push_bytes <= 64, "{}: {} bytes of push constants", module.name, module.push_bytes);
        assert!(module.bindings.len() <= 12, "{}: {} bindings", module.name, module.bindings.len());
    }
}
