use crate::{Folder, cancel::cancelled_when, command};
use std::{
    sync::atomic::AtomicBool,
    time::{Duration, Instant},
};
use zipsplat::types::{Origin, Scene, World, poses::Capture, read_world};

fn place() -> Folder {
    let folder = Folder::new();
    folder.run("scene --seed 5 --views 10 --size 42x28 -o @/place").success();
    folder
}

const PHOTOS: &str = "@/place/images --cameras @/place/transforms.json";

#[test]
fn points_become_a_scene_that_looks_like_the_photos() {
    let folder = place();
    let line = format!("refine {PHOTOS} --init points --steps 30 --holdout-views 1 -o @/scene.ply --explain --json");
    let json = folder.run(&line).json();
    let scene = Scene::open(folder.path("scene.ply")).expect("a scene");
    let losses: Vec<f64> =
        json["refined"]["losses"].as_array().expect("losses").iter().filter_map(|v| v.as_f64()).collect();
    assert_eq!((scene.len() as u64, losses.len()), (json["gaussians"].as_u64().expect("a number"), 30));
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len() as f64;
    assert!(mean(&losses[25..]) < 0.8 * mean(&losses[..5]), "{losses:?}");
    let held_out = json["refined"]["holdout_psnr_by_step"].as_array().expect("looks");
    let psnr = |i: usize| held_out[i][1].as_f64().expect("dB");
    assert!(psnr(held_out.len() - 1) > psnr(0) + 1.0, "{held_out:?}");
    assert!(json["explain"]["passes"].as_array().is_some_and(|passes| passes.len() > 10), "{}", json["explain"]);
    let first = folder.capture("place").frames[0].camera.pose;
    let Some(World { origin: Origin::Cameras(pose), .. }) = read_world(folder.path("scene.ply")).expect("a world")
    else {
        panic!("another world")
    };
    assert!(pose.translation.abs_diff_eq(first.translation, 1e-9));
    let again = format!("refine {PHOTOS} --init points --steps 30 --holdout-views 1 -o @/again.ply");
    let text = folder.run(&format!("{again} --explain")).success();
    assert!(text.contains("held-out photos") && !text.contains("left out"), "{text}");
    let row = |what: &str| text.lines().find_map(|line| line.strip_prefix(what)).unwrap_or_else(|| panic!("{text}"));
    assert_eq!(row("init").trim(), "the capture's points");
    assert!(row("steps").contains("30 of 30, of 4 photos each; kept is step "), "{text}");
    assert!(row("rates").contains("means 0.005"), "{text}");
    let names = std::fs::read_dir(folder.path("place/images")).expect("photos").map(|file| file.expect("a file"));
    let held_out = row("held-out photos").trim();
    assert!(names.map(|file| file.file_name()).any(|name| name == held_out), "{held_out}");
    assert_eq!((row("largest photo").trim(), row("stop reason").trim()), ("42x28 from step 1", "after all steps"));
    assert_eq!(Scene::open(folder.path("again.ply")).expect("a scene"), scene);
    let text = folder.run(&format!("refine {PHOTOS} --init points --steps 0s -o @/time.ply --explain")).success();
    assert!(text.contains("1 of 1, of 4 photos each"), "{text}");
}

#[test]
fn scenes_are_antialiased_as_asked_or_as_tagged() {
    let folder = place();
    let refined = |files: &str, options: &str, output: &str| {
        folder.run(&format!("refine {files} {PHOTOS} --steps 2 {options} -o @/{output} --overwrite")).success();
        Scene::open(folder.path(output)).expect("a scene").antialiased
    };
    assert!(!refined("", "--init points", "plain.ply"));
    for output in ["tagged.ply", "tagged.spz", "tagged.sog"] {
        assert!(refined("", "--init points --antialiased", output), "{output}");
        assert!(refined(&format!("@/{output}"), "", "again.ply"), "{output}");
    }
    assert!(!refined("@/tagged.ply", "--antialiased=false", "again.ply"));
    let eval = "eval @/place --views 3 --weights @/micro.safetensors --input-size 28x28 --lpips none -o @/out";
    folder.run(&format!("{eval} --antialiased")).fails(3, &["--antialiased", "--refine"]);
    folder.run("view @/place/images --antialiased -o @/page.html").fails(3, &["--antialiased", "--refine"]);
    folder.run("reconstruct @/place/images --antialiased -o @/scene.ply").fails_usage();
}

#[test]
fn a_scene_is_refined_in_its_own_world() {
    let folder = place();
    let reconstruct = "reconstruct @/place/images --cameras @/place --weights @/micro.safetensors --input-size 28x28";
    folder.run(&format!("{reconstruct} -o @/first.ply")).success();
    folder.run(&format!("{reconstruct} --world input-cameras -o @/cameras.ply")).success();
    let refined = |name: &str, options: &str| {
        let line = format!("refine @/{name}.ply {PHOTOS} --steps 5 {options} -o @/refined.ply --overwrite --json");
        let json = folder.run(&line).json();
        let world = read_world(folder.path("refined.ply")).expect("a world");
        assert_eq!(world, read_world(folder.path(&format!("{name}.ply"))).expect("a world"));
        let losses = json["refined"]["losses"].as_array().expect("losses").clone();
        (
            losses.iter().filter_map(|loss| loss.as_f64()).collect::<Vec<_>>(),
            Scene::open(folder.path("refined.ply")).expect("a scene").len(),
        )
    };
    let ((first, count), (cameras, _)) = (refined("first", ""), refined("cameras", ""));
    let alike = first.iter().zip(&cameras).all(|(a, b)| (a - b).abs() < 1e-3);
    assert!(alike && first.len() == 5, "{first:?} and {cameras:?}");
    let points = folder.capture("place").points.expect("a cloud");
    let points = zipsplat::types::read_points(points).expect("points").positions.len();
    assert_eq!(refined("first", "--init both --max-gaussians 0").1, count + points);
}

#[test]
fn an_interrupted_refinement_continues() {
    let folder = place();
    let line = |name: &str| format!("refine {PHOTOS} --init points --steps 400 -o @/{name}.ply");
    folder.run(&line("whole")).success();
    let checkpoint = folder.path("scene.ply.checkpoint");
    for milliseconds in (1..).map(|i| 150 * i) {
        let begin = Instant::now();
        let is_late = || begin.elapsed() > Duration::from_millis(milliseconds);
        assert_eq!(cancelled_when(&folder.line(&line("scene")), is_late).code, 130);
        if checkpoint.exists() {
            break;
        }
    }
    let other = folder.run(&format!("{} --seed 1", line("scene")));
    other.fails(3, &["scene.ply.checkpoint", "options", "delete"]);
    let json = folder.run(&format!("{} --json", line("scene"))).json();
    assert!(json["refined"]["resumed_step"].as_u64() > Some(0) && !checkpoint.exists(), "{json}");
    assert_eq!(folder.read("scene.ply"), folder.read("whole.ply"));
}

#[test]
fn refined_cameras_are_written() {
    let folder = place();
    let options = "--steps 20 --optimize-cameras --holdout-views 1 --cameras-out @/cameras.json";
    let refined = folder.run(&format!("refine {PHOTOS} --init points {options} -o @/scene.ply --json")).json();
    let degrees = refined["refined"]["camera_movement"]["rotation_deg"].as_f64().expect("an angle");
    let [given, found] = ["place/transforms.json", "cameras.json"].map(|file| folder.capture(file));
    let moved = |i: usize| {
        let (given, found) = (&given.frames[i].camera, &found.frames[i].camera);
        assert_eq!(given.intrinsics, found.intrinsics);
        !found.pose.matrix().abs_diff_eq(given.pose.matrix(), 1e-9)
    };
    assert_eq!((0..10).filter(|i| !moved(*i)).collect::<Vec<_>>(), [0, 5]);
    assert!((1e-3..2.0).contains(&degrees), "{degrees}");
    assert!(found.frames.iter().zip(&given.frames).all(|(found, given)| found.photo.is_some()
        && found.photo.as_ref().map(|path| path.file_name()) == given.photo.as_ref().map(|path| path.file_name())));
    let points = |capture: &Capture| capture.points.as_ref().and_then(|points| points.canonicalize().ok());
    assert!(points(&given).is_some() && points(&found) == points(&given));
    let again = "refine @/scene.ply @/place/images --cameras @/cameras.json --steps 0 -o @/again.ply --json";
    assert!(folder.run(again).json()["refined"]["camera_movement"].is_null());
    let reconstruct = format!("reconstruct {PHOTOS} --weights @/micro.safetensors --input-size 28x28 -o @/sharp.ply");
    folder
        .run(&format!("{reconstruct} --refine=5 --init points --optimize-cameras --cameras-out @/new/r.json"))
        .success();
    assert!(folder.capture("new/r.json").frames[1].camera != given.frames[1].camera);
    assert_eq!(folder.run(&format!("{reconstruct} --optimize-cameras")).code, 2);
    let known = folder.run(&format!("{reconstruct} --refine=5 --cameras-out @/r.json"));
    known.fails(3, &["--cameras-out", "--optimize-cameras"]);
}

#[test]
fn scenes_grow() {
    let folder = place();
    let line = format!("refine {PHOTOS} --init points --steps 20 --max-gaussians 3000 -o @/scene.ply --json");
    let json = folder.run(&line).json();
    let points = folder.capture("place").points.expect("a cloud");
    let points = zipsplat::types::read_points(points).expect("points").positions.len() as u64;
    let grown = json["gaussians"].as_u64().expect("a number");
    assert!(points < grown && grown <= 3000, "{points} points and {grown} Gaussians");
    let reconstruct = format!("reconstruct {PHOTOS} --weights @/micro.safetensors --input-size 28x28 -o @/sharp.ply");
    folder
        .run(&format!("{reconstruct} --refine=5 --refine-target tokens --max-gaussians 3000"))
        .fails(3, &["--max-gaussians", "tokens"]);
    assert_eq!(folder.run(&format!("refine {PHOTOS} --init points --max-gaussians few -o @/scene.ply")).code, 2);
    let gaussians = |options: &str| {
        let line = format!("refine {PHOTOS} --init points {options} -o @/scene.ply --overwrite --json");
        folder.run(&line).json()["gaussians"].as_u64().expect("a number")
    };
    assert_eq!(gaussians("--steps 50 --max-gaussians 0"), points);
    let of_stereo = gaussians("--steps 20");
    assert!(of_stereo > points && gaussians("--steps 50") > of_stereo, "{of_stereo}");
    assert_eq!(gaussians(&format!("--steps 20 --max-gaussians {}", points + 9)), points + 9);
}

#[test]
fn what_cannot_be_refined_is_refused() {
    let folder = place();
    folder.scatter("scene.ply", 50, 0, 0.1);
    let scene = format!("refine @/scene.ply {PHOTOS}");
    folder.run(&format!("{scene} -o @/out.txt")).fails(3, &["--output"]);
    folder.run(&format!("{scene} --holdout-views 10 -o @/out.ply")).fails(3, &["held-out", "fewer than the 10"]);
    folder.run("refine @/scene.ply --cameras @/place -o @/out.ply").fails(3, &["photos", "none"]);
    folder.remove("place/points.ply");
    folder.run(&format!("refine {PHOTOS} --init points -o @/out.ply")).fails(3, &["no point cloud", "--init scene"]);
    command(&folder.line(&format!("{scene} -o @/out.ply")), &AtomicBool::new(true)).fails(130, &["cancelled"]);
    assert!(!folder.path("out.ply").exists());
}

#[test]
fn held_out_photos_are_compared_after_a_refinement() {
    let folder = place();
    let line =
        "eval @/place --views 6 --targets 2 --weights @/micro.safetensors --input-size 28x28 --eval-size 30x20 --json";
    let psnr = |options: &str| folder.run(&format!("{line} {options}")).json()["mean"]["psnr"].as_f64().expect("dB");
    let (before, points) = (psnr(""), psnr("--refine 0 --init points"));
    let refined = folder.run(&format!("{line} --refine 30:gaussians --init points")).json();
    assert_eq!((&refined["score_width"], &refined["width"]), (&30.into(), &28.into()));
    let after = refined["mean"]["psnr"].as_f64().expect("dB");
    assert!(after > points + 1.0 && after > before + 1.0, "{before}, {points} and {after} dB");
    assert!(folder.run(&format!("{line} --refine 3 --init both")).json()["gaussians"].as_u64() > Some(6 * 2 * 4));
    let outcome = folder.run(&format!("{line} --refine tokens"));
    assert!(outcome.code == 2 && outcome.err.contains("steps"), "{}", outcome.err);
}

#[test]
fn reconstructions_are_refined() {
    let folder = place();
    let line = format!("reconstruct {PHOTOS} --weights @/micro.safetensors --input-size 28x28 --json");
    let run = |options: &str| folder.run(&format!("{line} {options} -o @/sharp.ply --overwrite")).json();
    for (options, start, network) in [
        // Unmeasured weights default to their own scene.
        ("--refine=8", "the scene", true),
        ("--refine=8 --refine-target tokens", "the network's tokens", true),
        ("--refine=8 --init both", "the scene and the capture's points", true),
        ("--refine=8 --init points", "the capture's points", false),
    ] {
        let json = run(options);
        assert_eq!(
            (&json["refined"]["init"], json["refined"]["steps"].as_u64()),
            (&start.into(), Some(8)),
            "{options}"
        );
        let ran = json["stage_seconds"]["backbone"].as_f64().is_some_and(|seconds| seconds > 0.0);
        assert_eq!(
            (ran, json["tokens"].is_u64(), json["stage_seconds"]["load weights"].is_f64()),
            (network, network, network)
        );
        assert_eq!(json["stage_seconds"]["stereo"].is_f64(), start.ends_with("points"), "{options}");
        let scene = Scene::open(folder.path("sharp.ply")).expect("a scene");
        assert_eq!(json["gaussians"].as_u64(), Some(scene.len() as u64));
    }
    for (start, of) in [("points", "the capture's points"), ("scene", "the scene")] {
        let line = format!(
            "{} --refine=8 --holdout-views 1 --init {start} -o @/sharp.ply --explain",
            line.replace("--json", "")
        );
        let text = folder.run(&line).success();
        assert!(text.contains(&format!("from {of}, refined for ")), "{text}");
        assert!(text.contains("against 9 photos"), "{text}");
        assert_eq!(text.contains("tokens"), start == "scene", "{text}");
    }
    // More than a pass takes.
    let many = PHOTOS.replace("@/place/images", &["@/place/images"; 20].join(" "));
    let text = folder.run(&format!("reconstruct {many} --refine=2 --init points -o @/many.ply")).success();
    assert!(text.contains("against 199 photos"), "{text}");
    let wrong = line.replace("--json", "--refine=8 --refine-target tokens --init points -o @/none.ply");
    folder.run(&wrong).fails(3, &["--init", "tokens"]);
    let unfound = "reconstruct @/photos --weights @/micro.safetensors --refine --colmap @/none -o @/none.ply";
    folder.run(unfound).fails(3, &["COLMAP"]);
    assert!(!folder.path("none.ply").exists());
}
