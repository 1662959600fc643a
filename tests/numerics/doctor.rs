use zipsplat_tests::command;

pub fn zipsplat(line: &str) -> (u8, String, String) {
    let (code, out, err) = command::zipsplat(line);
    (code, String::from_utf8(out).expect("results are text"), err)
}

#[test]
fn the_command_tells_and_reports() {
    let folder = tempfile::tempdir().unwrap();
    let page = folder.path().join("page.html");
    let (code, out, err) = zipsplat(&format!("doctor --only ops/layer --json --report {}", page.display()));
    assert_eq!(code, 0, "{err}");
    let json: serde_json::Value = serde_json::from_str::<serde_json::Value>(&out).unwrap()["result"].clone();
    let findings = json["findings"].as_array().unwrap();
    assert!(findings.len() > 5 && findings.iter().all(|f| f["kernel"] == "ops/layer_norm" && f["holds"] == true));
    assert!(findings.iter().all(|f| f["catches"].as_array().is_some_and(|faults| !faults.is_empty())));
    assert!(findings.iter().any(|f| f["share"].as_f64().unwrap() > 0.0), "something was rounded");
    assert_eq!(json["outside"], 0);
    let html = std::fs::read_to_string(&page).unwrap();
    for part in ["<svg", "ops/layer_norm, exact", "corrected two-pass", "truth\n</text>", "bound\n</text>"] {
        assert!(html.contains(part), "{part}");
    }
    assert!(!html.replace("http://www.w3.org/2000/svg", "").contains("http"), "self-contained");

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
