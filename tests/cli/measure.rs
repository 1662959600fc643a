//! No test asserts a time.

use crate::Folder;
use serde_json::Value;
use zipsplat::ops::{Arithmetic, Precision};
use zipsplat_tests::{device::device, processes::child};

fn rows(folder: &Folder, line: &str) -> Vec<Value> {
    let rows = folder.run(&format!("bench {line} --warmup 1 --repeats 2 --json")).json();
    rows.as_array().expect("a list of rows").clone()
}

fn ordered(ms: &Value) -> bool {
    let number = |key: &str| ms[key].as_f64().unwrap_or(f64::NAN);
    0.0 <= number("min") && number("min") <= number("median") && number("median") <= number("max")
}

fn shared(share: &Value, expected: bool) -> bool {
    // On a busy machine the measured limit may be too low.
    share.as_f64().map_or(share.is_null() && !expected, |share| expected && share > 0.0 && share < 20.0)
}

#[test]
fn limits_are_measured_by_work_that_is_done() {
    let rows = rows(&Folder::new(), "peak");
    let matrices = device().limits().matrices;
    let kinds = [matrices.f16, matrices.bf16, matrices.i8].iter().flatten().count();
    let expected = [vec!["multiply-add"], vec!["matrices"; kinds], vec!["copy"]].concat();
    assert_eq!(rows.len(), expected.len());
    for (row, what) in rows.iter().zip(expected) {
        assert!(row["what"].as_str().is_some_and(|name| name.starts_with(what)), "{row}");
        assert!(
            row["per_s"].as_f64().is_some_and(|rate| rate > 0.0 && rate.is_finite()) && ordered(&row["ms"]),
            "{row}"
        );
        assert_eq!(row["difference"], 0.0, "{row}");
    }
    let text = Folder::new().run("bench peak --warmup 0 --repeats 1").success();
    assert!(text.contains("multiply-add, f32") && text.contains("GFLOP/s") && text.contains("GB/s"), "{text}");
}

#[test]
fn forward_adds_up() {
    let folder = Folder::new();
    let rows = rows(&folder, "forward --weights @/micro.safetensors --views 1,2 --ratio 1,0.5 --input-size 28x28");
    assert!(rows.iter().all(|row| shared(&row["peak_share"], row["gflop"].as_f64() > Some(0.0))), "{rows:?}");
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
fn frames_are_measured_by_pass() {
    let folder = Folder::new();
    let rows = rows(&folder, "render --gaussians 50,300 --size 32x32,48x32 --sh 0");
    for what in ["host", "device", "in flight", "sort by depth", "sort by tile", "render/project", "render/rasterize"] {
        assert_eq!(rows.iter().filter(|row| row["what"] == what).count(), 4, "{what}");
    }
    let share = |row: &Value| row["bandwidth_share"].as_f64().is_some_and(|share| share > 0.0);
    assert!(rows.iter().all(|row| share(row) == row["bytes"].is_u64()), "{rows:?}");
    assert!(rows.iter().all(|row| ordered(&row["ms"])), "{rows:?}");
    let text = folder.run("bench render --gaussians 50 --size 32x32 --warmup 0 --repeats 1").success();
    assert!(text.contains("frames/s") && text.contains("render/rasterize"), "{text}");
}

#[test]
fn a_step_is_measured_beside_its_picture() {
    let rows = rows(&Folder::new(), "refine --gaussians 50,300 --size 32x32 --sh 0 --photos 2");
    let passes =
        ["render/rasterize", "render/rasterize_backward", "render/project_backward", "loss/gradient", "refine/adam"];
    for what in passes.into_iter().chain(["step", "picture", "host"]) {
        assert_eq!(rows.iter().filter(|row| row["what"] == what).count(), 2, "{what}: {rows:?}");
    }
    assert!(rows.iter().all(|row| ordered(&row["ms"]) && row["pictures"].as_f64() > Some(0.0)), "{rows:?}");
    for row in rows.iter().filter(|row| row["what"] == "step") {
        assert!(shared(&row["bandwidth_share"], true) && shared(&row["fma_share"], true), "{row}");
        assert!(row["peak_bytes"].as_u64() > Some(0) && row["photos"] == 2, "{row}");
    }
    let text = Folder::new().run("bench refine --gaussians 50 --size 32x32 --warmup 0 --repeats 1").success();
    assert!(text.contains("of bandwidth") && text.contains("render/rasterize_backward"), "{text}");
    Folder::new().run("bench refine --sh 2 --pytorch python3").fails(3, &["--sh", "0 or 1"]);
    Folder::new().run("bench refine --pytorch no-such-python").fails(3, &["--pytorch", "no-such-python", "numba"]);
}

/// One Python prints its request, one fails.
#[cfg(unix)]
#[test]
fn pytorch_stands_beside_ours() {
    let folder = Folder::new();
    let row = |views: u32, ratio: f64, ms: &str| {
        format!(r#"{{"precision": "f32", "views": {views}, "ratio": {ratio}, {ms}, "peak_bytes": null}}"#)
    };
    let rows = [row(1, 1.0, r#""ms": [4, 2, 3]"#), row(2, 1.0, r#""failed": "out of memory""#)].join(",");
    let measured = format!("cat > /dev/null\necho '{{\"device\": \"a GPU\", \"torch\": \"9.9\", \"rows\": [{rows}]}}'");
    for (name, body) in [("python", measured), ("broken", "echo 'No module named torch' >&2; exit 1".into())] {
        folder.script(name, &format!("#!/bin/sh\n{body}\n"));
    }
    let line = "bench forward --weights @/micro.safetensors --views 1,2 --input-size 28x28 --precision fp32 --warmup 0 --repeats 1 --pytorch @/";
    let text = folder.run(&format!("{line}python")).success();
    for word in [
        "peak: multiply-add, f32",
        "of peak",
        "PyTorch 9.9 on a GPU",
        "3.000 (2.000..4.000)",
        "out of memory",
        "its time / ours",
    ] {
        assert!(text.contains(word), "'{word}' is not in: {text}");
    }
    folder.run(&format!("{line}broken")).fails(3, &["--pytorch", "No module named torch"]);
    folder.run(&format!("{line}absent")).fails(3, &["--pytorch", "absent"]);
}

#[test]
fn depth_is_timed_by_backbone_and_head() {
    let folder = Folder::new().with_depth();
    let line = "bench depth --weights @/da3.safetensors --views 1,2 --input-size 28x28,42x28 --precision fp32 --warmup 0 --repeats 1";
    let rows = folder.run(&format!("{line} --json")).json();
    let rows = rows.as_array().expect("rows");
    let stages = |row: &&serde_json::Value| row["kernel"] == "" && row["views"] == 2 && row["width"] == 42;
    let found: Vec<&str> = rows.iter().filter(stages).map(|row| row["stage"].as_str().expect("a name")).collect();
    assert_eq!(found, ["", "backbone", "heads/camera", "heads/levels", "heads/depth", "heads/rays"]);
    assert_eq!(rows.iter().filter(|row| row["stage"] == "").count(), 4);
    let all = rows.iter().filter(stages).map(|row| row["gflop"].as_f64().expect("a number"));
    let all: Vec<f64> = all.collect();
    assert!(all[0] > 0.0 && (all[1..].iter().sum::<f64>() / all[0] - 1.0).abs() < 1e-9, "{all:?}");
    assert!(
        rows[0]["arena_bytes"].as_u64() > Some(0) && rows[0]["peak_bytes"].as_u64() > rows[0]["arena_bytes"].as_u64()
    );
    folder.run(&format!("{line} --pytorch no-such-python")).fails(3, &["--pytorch", "no-such-python"]);
    let alone = "bench depth --weights @/alone.safetensors --size 28x28 --pytorch python3";
    folder.run(alone).fails(3, &["--pytorch", "da3-micro-alone", "all photos at once"]);
    folder.run("bench depth --weights @/da3.safetensors --input-size 27x28").fails(3, &["27"]);
    folder.run("bench depth --weights @/micro.safetensors").fails(3, &["micro.safetensors", "da3-base"]);
}

#[test]
fn what_accuracy_costs_is_a_page_and_a_table() {
    let folder = Folder::new();
    // Empty pictures would be equal.
    folder.run("scene --seed 3 --views 6 --size 42x28 -o @/place").success();
    let line = "bench tradeoff @/place --weights @/micro.safetensors --input-size 42x28 --views 2,3 --ratio 1,0.5 \
                --token-selection kmeans,mutual,random:3 --max-gaussians-per-token 4,1 --refine 0,3,4:tokens --dtype f16,q8 --repeats 1 --targets 2 --scene-scale 1.5 -o @/report --json";
    let points = folder.run(line).json();
    let points = points.as_array().expect("a list");
    // Per number of photos: all tokens, and half of them by three selections, twice, in each
    // arithmetic. First values are also refined and rounded twice, points refined once.
    let has = |precision: &Precision| Arithmetic::of(*precision, device().limits()).is_some();
    let arithmetics = Precision::ALL.iter().filter(|precision| has(precision)).count();
    assert_eq!(points.len(), 2 * (1 + 3) * 2 * arithmetics + 2 * 2 * 2 + 2 * 2 * 2 + 2);
    let csv = folder.text("report/tradeoff.csv");
    assert_eq!(csv.lines().count(), 1 + points.len());
    let html = folder.text("report/tradeoff.html");
    assert_eq!(html.matches("<svg").count(), 1 + 12 + 8);
    assert!(html.contains(folder.text("report/tradeoff.svg").trim_start_matches("<!-- zipsplat -->\n")));
    assert_eq!(folder.text("report/figures.svg").matches("<svg").count(), 1 + 6);
    assert_eq!(html.matches("class=\"panel\"").count(), points.len());
    let cards = html.matches("class=\"card\"").count();
    assert!((3..=5).contains(&cards), "{cards}");
    assert_eq!(html.matches("src=\"data:image/jpeg;base64,").count(), cards + points.len());
    assert!((0..points.len()).all(|i| html.contains(&format!("<tr data-point=\"{i}\""))), "a point has no row");
    assert!(!html.contains("src=\"http") && !html.contains("href"), "it needs other files");
    for point in points {
        let number = |key: &str| point[key].as_f64().unwrap_or(f64::NAN);
        let is_of_points = point["init"] == "points";
        assert_eq!(
            number("gaussians") == number("tokens") * number("max_gaussians_per_token"),
            !is_of_points,
            "{point}"
        );
        assert_eq!(number("forward_ms") > 0.0, !is_of_points, "{point}");
        assert!(number("render_ms") > 0.0 && number("psnr") > 0.0, "{point}");
        let command = point["command"].as_str().expect("a command");
        let (convert, command) = command.split_once(" && ").map_or((None, command), |(a, b)| (Some(a), b));
        let ours = |command: &str| command.strip_prefix("zipsplat ").expect("it is ours").to_owned();
        let is_rounded = point["weights"] != "own";
        assert_eq!(convert.is_some(), is_rounded, "{point}");
        let is_exact = point["precision"] == "fp32" && !is_rounded;
        let is_refined = point["refine"] != "0";
        assert_eq!(number("refine_ms") > 0.0, is_refined, "{point}");
        assert!((number("total_ms") - number("forward_ms") - number("refine_ms")).abs() < 1e-6, "{point}");
        // Exact in f16: JSON cannot represent the infinite PSNR.
        assert_eq!(point["psnr_to_fp32"].is_null(), is_exact || point["weights"] == "f16", "{point}");
        assert_eq!(point["psnr_to_f64"].is_null(), is_refined, "{point}");
        if !is_exact && point["token_selection"] == "all" {
            assert!(number("psnr_to_fp32").is_nan() || number("psnr_to_fp32") > 40.0, "{point}");
        }
        // Roundings of 24, 11 and 8 bits.
        let most = match (point["precision"].as_str(), point["weights"].as_str()) {
            (Some("fp32"), Some("own")) => 1e-5,
            (Some("fp32"), Some("f16")) | (Some("fp16"), _) => 1e-2,
            _ => 1e-1,
        };
        for part in ["backbone", "fuse", "means", "scales", "quats", "opacities", "sh_coeffs"] {
            let error = number(&format!("error_{part}"));
            assert!(error.is_nan() == is_of_points && !(error <= 0.0 || error >= most), "{part}: {error} of {point}");
        }
        assert!(is_refined || number("psnr_to_f64") > if is_exact { 80.0 } else { 40.0 }, "{point}");
        if number("views") == 3.0 {
            let file = format!("{}.safetensors", point["weights"].as_str().expect("a type"));
            let in_folder = |command: &str| ours(command).replace(&file, &folder.path(&file).to_string_lossy());
            convert.iter().for_each(|convert| drop(crate::zipsplat(&in_folder(convert)).success()));
            let command = in_folder(command);
            let rerun = crate::zipsplat(&format!("{command} --json")).json();
            assert_eq!(rerun["gaussians"], point["gaussians"], "{command}");
            assert!(is_refined || rerun["peak_bytes"] == point["peak_bytes"], "{command}");
            let psnr = rerun["mean"]["psnr"].as_f64().expect("a number");
            assert!((psnr - number("psnr")).abs() < 1e-9, "{command}: {psnr} and {point}");
        }
    }
    let starts = points.iter().filter(|point| point["refine"] == "3").map(|point| point["init"].as_str());
    assert_eq!(starts.filter(|init| *init == Some("points")).count(), 2, "one a number of photos");
    folder.run("bench tradeoff @/place --views 6 --weights @/micro.safetensors -o @/r").fails(3, &["more than"]);
    folder
        .run("bench tradeoff @/place --views 2 --token-selection kmeans:0 -o @/r")
        .fails(3, &["rounds of k-means", "1 to 100"]);
    folder.run("bench tradeoff @/place --views 2 --dtype q4 -o @/r").fails_usage();
    assert!(!folder.path("r").exists());
}

#[test]
fn a_sweep_ends_when_its_time_is_over() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 6 --size 28x28 -o @/place").success();
    let line = "bench tradeoff @/place --weights @/micro.safetensors --input-size 28x28 --views 3,2 --max-gaussians-per-token all,1 --targets 1 --json";
    let outcome = folder.run(&format!("{line} --minutes 1e-9 -o @/report"));
    for words in ["1 most informative of ", "--minutes all"] {
        assert!(outcome.err.contains(words), "'{words}' is not in: {}", outcome.err);
    }
    let points = outcome.json();
    assert_eq!(points.as_array().map(Vec::len), Some(1));
    assert_eq!(
        (&points[0]["views"], &points[0]["ratio"], &points[0]["max_gaussians_per_token"]),
        (&3.into(), &1.0.into(), &4.into())
    );
    folder.run(&format!("{line} --minutes 0 -o @/r")).fails_usage();
}

#[test]
fn pooled_keys_are_points_of_their_own() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 6 --size 42x42 -o @/place").success();
    let line = "bench tradeoff @/place --weights @/micro.safetensors --input-size 42x42 --views 3 --ratio 1 --kv-pool 1,2 --max-gaussians-per-token 4 \
                --refine 0 --precision fp32 --warmup 0 --repeats 1 --targets 1 --scene-scale 1.5 -o @/report --json";
    let points = folder.run(line).json();
    let points: Vec<_> = points.as_array().expect("a list").iter().filter(|point| point["weights"] == "own").collect();
    assert_eq!(points.iter().map(|point| point["kv_pool"].as_str()).collect::<Vec<_>>(), [Some("1"), Some("2")]);
    assert!(points.iter().all(|point| point["error_fuse"].as_f64().is_some_and(|error| error < 1e-5)), "{points:?}");
    assert_ne!(points[0]["psnr"], points[1]["psnr"]);
    let commands = points.iter().map(|point| point["command"].as_str().expect("a command").contains("--kv-pool 2"));
    assert_eq!(commands.collect::<Vec<_>>(), [false, true]);
    let html = folder.text("report/tradeoff.html");
    assert!(html.contains("Patches that attention sees as one"));
}

#[test]
fn effects_are_measured_off_and_on() {
    let rows = rows(&Folder::new(), "render --gaussians 50 --size 32x32 --effects");
    assert_eq!(rows.len(), 7);
    for row in rows {
        assert!(["off", "on"].iter().all(|key| ordered(&row[key])), "{row}");
    }
}

#[test]
fn gsplat_that_is_missing_is_named() {
    let line = "bench render --gaussians 50 --size 32x32 --warmup 0 --repeats 1";
    let folder = Folder::new();
    folder.run(&format!("{line} --gsplat no-such-python")).fails(3, &["--gsplat", "no-such-python", "a CUDA GPU"]);
}

#[test]
fn a_report_has_every_part_in_its_tables() {
    const PROGRAM: &str = r#"#!/usr/bin/env bash
cd "$(dirname "$0")" && echo "$*" > line && eval "$(cat words)" >&2
python3 -c 'import json, sys; code, out, err = json.load(open("outcome")); print(out); print(err, file=sys.stderr); sys.exit(code)'"#;
    let folder = Folder::new();
    folder.script("program", PROGRAM);
    let report = concat!(env!("CARGO_MANIFEST_DIR"), "/../tools/bench/report.sh");
    let shell = format!("printf '%q ' \"$@\" > words; set -- {report} report");
    let mut run = child("weights::runs_a_line", &folder.path(""), &shell);
    run.current_dir(folder.path("")).env("ZIPSPLAT", folder.path("program"));
    run.env("WEIGHTS", folder.path("micro.safetensors")).env("VIEWS", "1 2").env("SIZE", "28x28").env("SCENES", "200");
    run.env("RUNS", "--warmup 0 --repeats 1").env("PARTS", "device peak forward refine absent");
    let out = run.output().expect("bash");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let results: Value = serde_json::from_str(&folder.text("report/results.json")).expect("JSON");
    let names: Vec<_> = results.as_object().expect("parts").keys().map(String::as_str).collect();
    assert_eq!(names, ["device", "forward-1", "forward-1-fp32", "forward-2", "forward-2-pool", "peak", "refine"]);
    assert!(names.iter().all(|name| results[name]["failed"].is_null()), "{results}");
    let tables = folder.text("report/tables.md");
    let rows = |start: &str| tables.lines().filter(|line| line.starts_with(start)).count();
    assert_eq!((rows("| 1 | "), rows("| 2 | "), rows("| 200 | "), rows("| 102,000 | ")), (4, 5, 1, 1), "{tables}");
}

#[test]
fn a_sweep_that_fails_writes_what_it_measured() {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 14 --size 84x84 -o @/place").success();
    let options = "--ratio 1 --token-selection kmeans --max-gaussians-per-token 4 --refine 0 --precision fp32";
    let line = format!(
        "bench tradeoff @/place --weights @/micro.safetensors --input-size 84x84 {options} --warmup 0 --repeats 1 --targets 1 \
         -o @/report"
    );
    let points = folder.run(&format!("{line} --views 12 --json")).json();
    let limit = points[0]["peak_bytes"].as_u64().expect("bytes") - 1;
    let outcome = folder.run(&format!("{line} --views 1,12 --max-memory {limit}"));
    assert!(outcome.err.contains("points that were measured"), "{}", outcome.err);
    outcome.fails(4, &["device memory are missing"]);
    assert_eq!(folder.text("report/tradeoff.csv").lines().count(), 2);
}
