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
    let exact = rows.iter().filter(|row| row["kernel"] == "exact").count();
    assert_eq!((exact, rows.len() % exact), (3, 0), "one a shape and kernel");
    for row in rows {
        // Both factors of a product are rounded to 11 bits.
        let most = if row["kernel"] == "exact" { 1e-5 } else { 1e-3 };
        assert!(row["difference"].as_f64().is_some_and(|difference| difference < most), "{row}");
        assert!(ordered(&row["device_ms"]) && ordered(&row["host_ms"]), "{row}");
    }
}

#[test]
fn frames_are_measured_by_kernel() {
    let folder = Folder::new();
    let rows = rows(&folder, "render --gaussians 50,300 --size 32x32,48x32 --sh 0");
    let count = |what: &str| rows.iter().filter(|row| row["what"] == what).count();
    assert_eq!((count("host"), count("device"), count("render/project"), count("render/rasterise")), (4, 4, 4, 4));
    assert!(rows.iter().all(|row| ordered(&row["ms"])), "{rows:?}");
    let text = folder.run("bench render --gaussians 50 --size 32x32 --warmup 0 --repeats 1").success();
    assert!(text.contains("frames/s") && text.contains("render/rasterise"), "{text}");
}
