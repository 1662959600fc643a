//! The catalog of `zipsplat doctor`.

use std::{collections::BTreeSet, ffi::OsString, sync::atomic::AtomicBool};
use zipsplat_cli::{
    Terminal,
    doctor::{Mode, catalogue},
    run,
};
use zipsplat_tests::device::device;

#[test]
pub fn every_kernel_stays_within_its_bounds() {
    let mut outside = Vec::new();
    let mut count = 0;
    for area in catalogue() {
        for (case, mode) in area.on(device().limits()) {
            let found = area.examine(case, device(), mode).unwrap();
            count += 1;
            let (mode, share) = (mode.name(), found.worst.share);
            println!("found: {}, {}, size {}, {mode}: {share:.2e} of the bound", found.kernel, found.case, found.size);
            if !found.holds {
                outside.push(format!("{} {mode} {}, size {}: {:?}", found.kernel, found.case, found.size, found.worst));
            }
        }
    }
    assert!(count > 150, "{count} cases");
    assert!(outside.is_empty(), "outside their bounds:\n{}", outside.join("\n"));
}

/// Injects each declared fault through its case's own check.
#[test]
fn every_case_catches_the_faults_that_it_is_there_for() {
    let mut missed = Vec::new();
    for area in catalogue() {
        for case in &area.cases {
            let mut injected = BTreeSet::new();
            // The largest cases take seconds per mode.
            let in_time = |mode: &&Mode| case.size < 50_000 || **mode == Mode::EXACT;
            for &mode in area.modes.iter().filter(in_time) {
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
            assert_eq!(injected, case.catches.iter().cloned().collect(), "{}, {}", area.kernel, case.name);
        }
    }
    assert!(missed.is_empty(), "not caught:\n{}", missed.join("\n"));
}

#[test]
fn areas_are_told_apart_and_explained() {
    let areas = catalogue();
    for area in &areas {
        assert!(area.reason.len() > 40 && !area.size.is_empty() && !area.modes.is_empty(), "{}", area.kernel);
        assert!(!area.cases.is_empty() && areas.iter().filter(|other| other.kernel == area.kernel).count() == 1);
        let mut names: Vec<_> = area.cases.iter().map(|case| (&case.name, case.size)).collect();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), area.cases.len(), "{}: two cases of one name and size", area.kernel);
    }
}

pub fn zipsplat(line: &str) -> (u8, String, String) {
    let args = std::iter::once("zipsplat").chain(line.split_whitespace()).map(OsString::from);
    let (mut out, mut err) = (Vec::new(), Vec::new());
    let cancelled = AtomicBool::new(false);
    let code = run(args, Terminal { out: &mut out, err: &mut err, progress: false, cancelled: &cancelled });
    let text = |bytes| String::from_utf8(bytes).expect("text");
    (code, text(out), text(err))
}

#[test]
fn the_command_tells_and_reports() {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.html");
    let (code, out, err) = zipsplat(&format!("doctor --only ops/layer --json --report {}", page.display()));
    assert_eq!(code, 0, "{err}");
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    let findings = json["findings"].as_array().unwrap();
    assert!(findings.len() > 5 && findings.iter().all(|f| f["kernel"] == "ops/layer_norm" && f["holds"] == true));
    assert!(findings.iter().all(|f| f["catches"].as_array().is_some_and(|faults| !faults.is_empty())));
    assert!(findings.iter().any(|f| f["share"].as_f64().unwrap() > 0.0), "something was rounded");
    assert_eq!(json["outside"], 0);
    let html = std::fs::read_to_string(&page).unwrap();
    for part in ["<svg", "ops/layer_norm, exact", "corrected two-pass", "class=truth", "class=bound"] {
        assert!(html.contains(part), "{part}");
    }
    assert!(!html.contains("http"), "self-contained");

    let (code, out, _) = zipsplat("doctor --only sort");
    assert!(code == 0 && out.contains("every result is within its bound"), "{out}");
    let rows = |out: &str| out.lines().filter(|line| line.starts_with("ops/sort")).count();
    assert_eq!(rows(&out), 1, "the worst case alone: {out}");
    let (_, every, _) = zipsplat("doctor --only sort --verbose");
    assert!(rows(&every) > 15, "every case: {every}");
    let (code, _, err) = zipsplat("doctor --only nothing");
    assert!(code == 3 && err.contains("ops/attention"), "{code} {err}");
    let (code, _, err) = zipsplat("doctor --only sort --report /no/such/folder/x.html");
    assert!(code == 3 && err.contains("folder"), "{code} {err}");
}
