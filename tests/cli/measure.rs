//! `zipsplat bench`: that it runs and that its numbers fit each other; no test asserts a time.

use crate::Folder;
use serde_json::Value;

fn rows(folder: &Folder, line: &str) -> Vec<Value> {
    let rows = folder.run(&format!("bench {line} --warmup 1 --repeats 2 --json")).json();
    rows.as_array().expect("a list of rows").clone()
}

fn ordered(ms: &Value) -> bool {
    let number = |key: &str| ms[key].as_f64().unwrap_or(f64::NAN);
    0.0 <= number("min") && number("min") <= number("median") && number("median") <= number("max")
}

#[test]
fn forward_adds_up() {
    let folder = Folder::new();
    let rows = rows(&folder, "forward --weights @/micro.safetensors --views 1,2 --ratio 1,0.5 --size 28x28");
    let whole: Vec<_> = rows.iter().filter(|row| row["stage"] == "").collect();
    assert_eq!(whole.len(), 4, "one a shape");
    assert!(rows.iter().all(|row| ordered(&row["ms"])), "{rows:?}");
    for total in whole {
        let same = |row: &&Value| row["views"] == total["views"] && row["tokens"] == total["tokens"];
        let sum = |stages: bool| -> f64 {
            let part = |row: &&Value| row["stage"] != "" && (row["kernel"] == "") == stages;
            rows.iter().filter(same).filter(part).filter_map(|row| row["gflop"].as_f64()).sum()
        };
        let all = total["gflop"].as_f64().expect("a number");
        assert!(
            (sum(true) - all).abs() < 1e-9 && (sum(false) - all).abs() < 1e-9,
            "{} {} {all}",
            sum(true),
            sum(false)
        );
    }
}

#[test]
fn the_linear_layer_and_the_host_agree() {
    let rows = rows(&Folder::new(), "gemm");
    assert_eq!(rows.len(), 3);
    for row in rows {
        assert!(row["difference"].as_f64().is_some_and(|difference| difference < 1e-5), "{row}");
        assert!(ordered(&row["device_ms"]) && ordered(&row["host_ms"]), "{row}");
    }
}

#[test]
fn frames_are_measured_by_pass() {
    let folder = Folder::new();
    let rows = rows(&folder, "render --gaussians 50,300 --size 32x32,48x32 --sh 0");
    for what in ["host", "device", "in flight", "sort by depth", "sort by tile", "render/project", "render/rasterise"] {
        assert_eq!(rows.iter().filter(|row| row["what"] == what).count(), 4, "{what}");
    }
    let share = |row: &Value| row["bandwidth_share"].as_f64().is_some_and(|share| share > 0.0);
    assert!(rows.iter().all(|row| share(row) == row["bytes"].is_u64()), "{rows:?}");
    assert!(rows.iter().all(|row| ordered(&row["ms"])), "{rows:?}");
    let text = folder.run("bench render --gaussians 50 --size 32x32 --warmup 0 --repeats 1").success();
    assert!(text.contains("frames/s") && text.contains("render/rasterise"), "{text}");
}

#[test]
fn frames_are_listed_as_csv() {
    let line = "bench render --gaussians 50 --size 32x32 --sh 0 --warmup 0 --repeats 1 --csv";
    let text = Folder::new().run(line).success();
    let mut lines = text.lines();
    let columns = lines.next().expect("headings").split(',').count();
    assert!(lines.clone().any(|line| line.starts_with("sort by depth,50,32,32,0,")), "{text}");
    assert!(lines.all(|line| line.split(',').count() == columns), "{text}");
}

#[test]
fn effects_are_measured_off_on_and_removed() {
    let rows = rows(&Folder::new(), "render --gaussians 50 --size 32x32 --effects");
    assert_eq!(rows.len(), 7);
    for row in rows {
        assert!(["off", "on", "removed"].iter().all(|key| ordered(&row[key])), "{row}");
        assert!(row["off_over_removed"].as_f64().is_some_and(|ratio| ratio > 0.0), "{row}");
    }
}

#[test]
fn gsplat_that_is_missing_is_named() {
    let line = "bench render --gaussians 50 --size 32x32 --warmup 0 --repeats 1";
    let folder = Folder::new();
    folder.run(&format!("{line} --gsplat=no-such-python")).fails(3, &["--gsplat", "no-such-python", "a CUDA GPU"]);
}
