//! The catalog of cases, by family of kernels, and its injected faults.

use std::collections::BTreeSet;
use zipsplat_tests::catalog::examine;
use zipsplat_verify::{Area, Case, Mode, catalog, shapes};

macro_rules! families {
    ($($test:ident: $prefix:literal,)*) => {
        const FAMILIES: &[&str] = &[$($prefix),*];
        $(
            #[test]
            fn $test() {
                examine($prefix);
            }
        )*
    };
}

families! {
    attention: "ops/attention",
    backbone: "camera encoding",
    cluster: "cluster",
    features: "features",
    gaussians: "gaussians/",
    gelu: "ops/gelu",
    heads: "heads/",
    layer_norm: "ops/layer_norm",
    linear: "ops/linear",
    loss: "loss",
    refine: "refine/",
    render: "render",
    sort: "ops/sort",
    split_heads: "ops/split_heads",
}

#[test]
fn every_kernel_is_in_a_family() {
    for area in catalog() {
        assert!(FAMILIES.iter().any(|family| area.kernel.starts_with(family)), "{}", area.kernel);
    }
}

/// Injects each declared fault: the deviation exceeds bound and rounding.
fn assert_caught(areas: Vec<Area>, in_time: impl Fn(&Area, &Case, Mode) -> bool) {
    let mut missed = Vec::new();
    for area in &areas {
        for case in &area.cases {
            let mut injected = BTreeSet::new();
            for &mode in area.modes.iter().filter(|mode| in_time(area, case, **mode)) {
                let faults = case.inject(mode);
                let what = format!("{}, {}, size {}, {}", area.kernel, case.name, case.size, mode.name());
                assert!(!faults.is_empty(), "{what}: nothing to catch");
                for found in faults {
                    println!("{what}: {} {:.2e}", found.fault, found.share);
                    if !found.is_caught() {
                        missed.push(format!("{what}: {} misses by {:.2e} of the bound", found.fault, found.share));
                    }
                    injected.insert(found.fault);
                }
            }
            injected.remove("zeros");
            assert_eq!(injected, case.catches.iter().cloned().collect(), "{}, {}", area.kernel, case.name);
        }
    }
    assert!(missed.is_empty(), "not caught:\n{}", missed.join("\n"));
}

#[test]
fn every_case_catches_the_faults_that_it_is_there_for() {
    // The largest cases take seconds per mode.
    assert_caught(catalog(), |_, case, mode| case.size < 50_000 || mode == Mode::EXACT);
}

#[test]
fn every_shape_catches_its_faults() {
    assert_caught(shapes(), |area, _, mode| mode == area.modes[0]);
}

#[test]
fn areas_are_told_apart_and_explained() {
    for areas in [catalog(), shapes()] {
        for area in &areas {
            assert!(area.reason.len() > 40 && !area.size.is_empty() && !area.modes.is_empty(), "{}", area.kernel);
            assert!(!area.cases.is_empty() && areas.iter().filter(|other| other.kernel == area.kernel).count() == 1);
            let mut names: Vec<_> = area.cases.iter().map(|case| (&case.name, case.size)).collect();
            names.sort();
            names.dedup();
            assert_eq!(names.len(), area.cases.len(), "{}: two cases of one name and size", area.kernel);
        }
    }
}
