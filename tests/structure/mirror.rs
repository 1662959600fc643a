//! A kernel, its verification and its reference share a relative name.

use crate::source::files;
use std::collections::BTreeSet;
use zipsplat::kernels::MODULES;

/// Kernels that are steps or variants of one operation, with their common name.
const STEPS: [(&str, &str); 27] = [
    ("cluster/nearest_matrix", "cluster/nearest"),
    ("cluster/nearest_merge", "cluster/nearest"),
    ("cluster/nearest_uniform", "cluster/nearest"),
    ("heads/convolution_uniform", "heads/convolution"),
    ("loss/dssim", "loss/gradient"),
    ("loss/moments", "loss/gradient"),
    ("loss/spread", "loss/gradient"),
    ("loss/value", "loss/gradient"),
    ("lpips/normalise_backward", "lpips/normalise"),
    ("lpips/pool_backward", "lpips/pool"),
    ("ops/attention_matrix", "ops/attention"),
    ("ops/attention_uniform", "ops/attention"),
    ("ops/linear_dot", "ops/linear"),
    ("ops/linear_matrix", "ops/linear"),
    ("ops/linear_merge", "ops/linear"),
    ("ops/linear_tiled", "ops/linear"),
    ("ops/linear_uniform", "ops/linear"),
    ("ops/scan_apply", "ops/sort"),
    ("ops/scan_reduce", "ops/sort"),
    ("ops/key_starts", "ops/sort"),
    ("ops/sort_count", "ops/sort"),
    ("ops/sort_scatter", "ops/sort"),
    ("render/cameras_backward", "render/backward"),
    ("render/color_backward", "render/backward"),
    ("render/project_backward", "render/backward"),
    ("render/rasterise_backward", "render/backward"),
    ("render/tile_counts", "render/intersect"),
];

/// Names without a reference, and their alternative.
const WITHOUT_REFERENCE: [(&str, &str); 2] = [
    ("ops/sort", "the stable sort of the standard library, a running sum"),
    ("render/intersect", "lists made on the host"),
];

/// Relative, such as `ops/add`.
fn names(folder: &str, ext: &str) -> BTreeSet<String> {
    let relative = |path: &str| path[folder.len() + 1..].trim_end_matches(&format!(".{ext}")).to_owned();
    files(folder, ext).iter().map(|source| relative(&source.path)).collect()
}

/// Returns the names that verifications and references must have.
fn shared_names() -> BTreeSet<String> {
    let shared = |kernel: String| match STEPS.iter().find(|(step, _)| *step == kernel) {
        Some((_, name)) => name.to_string(),
        None => kernel,
    };
    names("kernels", "comp").into_iter().map(shared).collect()
}

#[test]
fn every_kernel_has_its_verification_and_its_reference() {
    let (tests, references) = (names("tests/kernels", "rs"), names("kernels/reference", "rs"));
    let cases: BTreeSet<String> =
        names("kernels/verify", "rs").iter().map(|name| name.trim_end_matches("/mod").to_owned()).collect();
    let mut missing = Vec::new();
    for name in shared_names() {
        if !tests.contains(&name) && !cases.contains(&name) {
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
