use crate::Folder;
use std::path::Path;
use zipsplat::{stages::lpips::LpipsNetwork, types::Image};
use zipsplat_tests::{
    golden::lpips_weights,
    processes::{assert_succeeds, child, target},
};

fn gray(value: u8, width: u32, height: u32) -> Image {
    Image { width, height, rgb: vec![value; 3 * (width * height) as usize], mask: None }
}

fn folder() -> Folder {
    let folder = Folder::new();
    for name in ["a", "b"] {
        folder.make(name);
    }
    let save = |name: &str, value| gray(value, 40, 30).save_png(folder.path(name)).expect("a picture");
    [("a/one.png", 100), ("b/one.png", 151), ("a/two.png", 9), ("b/two.png", 9), ("a/three.png", 0)]
        .into_iter()
        .for_each(|(name, value)| save(name, value));
    folder
}

#[test]
fn two_pictures_are_compared() {
    let folder = folder();
    // 51 of 255 levels are 0.2.
    let json = folder.run("eval @/a/one.png @/b/one.png --lpips none --json").json();
    let row = &json["pictures"][0];
    assert!((row["psnr"].as_f64().expect("dB") - 13.979).abs() < 1e-3, "{row}");
    // Uniform pictures: (2 a b + c) / (a^2 + b^2 + c).
    let (a, b) = (100.0 / 255.0, 151.0 / 255.0f64);
    let ssim = (2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4);
    assert!((row["ssim"].as_f64().expect("a number") - ssim).abs() < 1e-6, "{row}");
    assert!(row["lpips"].is_null());
    let text = folder.run("eval @/a/two.png @/b/two.png --lpips none").success();
    assert!(text.contains("equal") && text.contains("1.0000"), "{text}");
}

#[test]
fn folders_are_compared_by_name() {
    let folder = folder();
    let outcome = folder.run("eval @/a @/b --lpips none --csv @/scores.csv --difference @/off --json");
    assert!(outcome.err.contains("1 picture without a partner") && outcome.err.contains("three"), "{}", outcome.err);
    let json = outcome.json();
    assert_eq!(json["pictures"].as_array().expect("rows").len(), 2);
    assert_eq!(json["mean"]["psnr"], json["pictures"][0]["psnr"]);
    let csv = folder.text("scores.csv");
    assert!(csv.starts_with("name,psnr,ssim,lpips\n") && csv.lines().count() == 3, "{csv}");
    folder.run("eval @/a @/b --lpips none --csv @/scores.csv").success();
    let off = Image::open(folder.path("off/one.png")).expect("a picture");
    assert!(off.rgb.iter().all(|value| *value == 4 * 51));
    assert!(Image::open(folder.path("off/two.png")).expect("a picture").rgb.iter().all(|value| *value == 0));
}

#[test]
fn what_cannot_be_compared_is_named() {
    let folder = folder();
    gray(1, 20, 20).save_png(folder.path("small.png")).expect("a picture");
    gray(1, 10, 20).save_png(folder.path("tiny.png")).expect("a picture");
    folder.run("eval @/a/one.png @/small.png --lpips none").fails(3, &["one", "40x30", "20x20"]);
    folder.run("eval @/tiny.png @/tiny.png --lpips none").fails(3, &["tiny", "10x20", "11x11"]);
    folder.run("eval @/a @/small.png --lpips none").fails(3, &["a folder and a picture"]);
    folder.run("eval @/a @/photos --lpips none").fails(3, &["same name", "none in"]);
    folder.run("eval @/a/one.png @/nothing.png --lpips none").fails(3, &["nothing.png"]);
    let early = "eval @/a/one.png @/small.png --lpips none";
    folder.run(&format!("{early} --csv @/missing/x.csv")).fails(3, &["output folder", "missing"]);
    folder.run(&format!("{early} --difference @/missing/x.png")).fails(3, &["output folder", "missing"]);
}

#[test]
fn pictures_too_small_for_lpips_are_counted() {
    if lpips_weights(LpipsNetwork::Alex).is_none() {
        return;
    }
    let folder = folder();
    let outcome = folder.run("eval @/a/one.png @/b/one.png --lpips alex --json");
    assert!(outcome.err.contains("1 pair without LPIPS") && outcome.err.contains("31x31"), "{}", outcome.err);
    assert!(outcome.json()["pictures"][0]["lpips"].is_null());
}

#[test]
fn absent_weights_are_named_with_the_command_that_fetches_them() {
    let folder = folder();
    let mut process = child("compare::without_weights", &folder.path(""), "");
    process.env("ZIPSPLAT_CACHE", folder.path("cache"));
    assert_succeeds(process);
}

#[test]
#[ignore = "a child of absent_weights_are_named_with_the_command_that_fetches_them"]
fn without_weights() {
    let run = |line: &str| crate::zipsplat(&line.replace('@', &target().expect("a folder").display().to_string()));
    let outcome = run("eval @/a/one.png @/b/one.png --json");
    assert!(outcome.err.contains("note: no LPIPS") && outcome.err.contains("tools/lpips.py"), "{}", outcome.err);
    assert!(outcome.json()["pictures"][0]["lpips"].is_null());
    run("eval @/a/one.png @/b/one.png --lpips vgg").fails(3, &["lpips_vgg.safetensors", "tools/lpips.py"]);
    let cache = std::env::var("ZIPSPLAT_CACHE").expect("a folder");
    std::fs::create_dir_all(&cache).expect("a folder");
    std::fs::write(Path::new(&cache).join("lpips_alex.safetensors"), [8u8; 99]).expect("a file");
    run("eval @/a/one.png @/b/one.png --lpips alex").fails(3, &["lpips_alex.safetensors"]);
}
