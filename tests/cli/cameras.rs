//! Cameras from COLMAP, fake or installed.
#![cfg(unix)]

use crate::{Folder, Outcome};
use std::{ffi::OsString, fs, path::Path, sync::atomic::AtomicBool};
use zipsplat::types::{Camera, Scene, median, poses::CaptureView, quaternion_from_matrix, read_points};
use zipsplat_cli::{Terminal, run};
use zipsplat_tests::processes::{child, target};

/// Version-dependent options of COLMAP 3's help.
pub const OPTIONS_3: [&str; 3] = [
    "--ImageReader.single_camera_per_folder arg --SiftExtraction.use_gpu arg (=1) --SiftExtraction.max_image_size arg",
    "--SiftMatching.use_gpu arg --ExhaustiveMatching.block_size arg",
    "--Mapper.tri_ignore_two_view_tracks arg --Mapper.ba_global_images_ratio arg --Mapper.ba_global_function_tolerance arg",
];
const OPTIONS_4: [&str; 3] = [
    "--ImageReader.single_camera_per_folder arg --FeatureExtraction.use_gpu arg --FeatureExtraction.max_image_size arg",
    "--FeatureMatching.use_gpu arg --ExhaustiveMatching.block_size arg",
    "--Mapper.tri_ignore_two_view_tracks arg --Mapper.ba_global_frames_ratio arg --Mapper.ba_global_function_tolerance arg",
];
pub const COPIES: &str = "cp -r \"$0.model/.\" \"$out\"";

pub fn place() -> (Folder, Vec<CaptureView>) {
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 4 --size 42x28 -o @/place").success();
    let frames = folder.capture("place").frames;
    folder.remove("place/transforms.json");
    folder.remove("place/points.ply");
    (folder, frames)
}

/// Logs its arguments and runs `features`, `matches` and `mapper`.
pub fn colmap(folder: &Folder, name: &str, version: &str, options: [&str; 3], bodies: [&str; 3]) {
    let [features, matches, mapper] = bodies;
    let text = format!(
        "#!/bin/sh
[ \"$1\" = help ] && {{ echo 'COLMAP {version} -- Structure-from-Motion'; exit 0; }}
[ \"$2\" = -h ] && {{ case $1 in feature_extractor) echo '{}';; matches_importer|*_matcher) echo '{}';; mapper) echo '{}';; esac; exit 1; }}
echo \"$QT_QPA_PLATFORM $@\" >>\"$0.args\"
step=$1
while [ $# -gt 1 ]; do case $1 in --output_path) out=$2;; --image_path) images=$2;; --match_list_path) pairs=$2;; esac; shift; done
case $step in
feature_extractor) {features};;
matches_importer|*_matcher) {matches};;
mapper) {mapper};;
esac
",
        options[0], options[1], options[2]
    );
    folder.script(name, &text);
}

/// Under COLMAP's photo names, with a distorted lens and points.
pub fn model(at: &Path, frames: &[(&str, &Camera)]) {
    fs::create_dir_all(at).expect("a folder");
    let (mut cameras, mut images) = (String::new(), String::new());
    for (i, (name, camera)) in frames.iter().enumerate() {
        let (lens, pose) = (&camera.intrinsics, camera.pose.inverse());
        let ([w, x, y, z], t) = (quaternion_from_matrix(&pose.rotation), pose.translation);
        let size = format!("{} {}", lens.width, lens.height);
        cameras += &format!("{i} SIMPLE_RADIAL {size} {} {} {} -0.05\n", lens.fx, lens.cx, lens.cy);
        images += &format!("{i} {w} {x} {y} {z} {} {} {} {i} {name}\n\n", t.x, t.y, t.z);
    }
    fs::write(at.join("cameras.txt"), cameras).expect("written");
    fs::write(at.join("images.txt"), images).expect("written");
    let points: String = (0..5).map(|i| format!("{i} {i} 2 3.5 10 20 30 0.1\n")).collect();
    fs::write(at.join("points3D.txt"), points).expect("written");
}

#[test]
fn names_that_files_of_cameras_cannot_hold_are_refused_first() {
    use std::os::unix::ffi::OsStrExt;
    let (folder, _) = place();
    colmap(&folder, "unused", "3.8", OPTIONS_3, [""; 3]);
    let images = folder.path("place/images");
    let latin = images.join(std::ffi::OsStr::from_bytes(b"caf\xe9.png"));
    fs::rename(images.join(&crate::names(&images)[0]), latin).expect("renamed");
    let outcome = folder.run("cameras @/place/images --colmap @/unused -o @/transforms.json");
    outcome.fails(3, &["name of a photo", "caf\\xE9.png", "UTF-8"]);
    assert!(!folder.path("unused.args").exists() && !folder.path("transforms.json").exists());
}

fn whole_model(folder: &Folder, name: &str, frames: &[CaptureView]) {
    let names: Vec<String> = (0..frames.len()).map(|i| format!("0/{i:06}.png")).collect();
    let named: Vec<_> = names.iter().map(String::as_str).zip(frames.iter().map(|frame| &frame.camera)).collect();
    model(&folder.path(&format!("{name}.model/0")), &named);
}

pub fn args(folder: &Folder, name: &str) -> String {
    folder.text(&format!("{name}.args"))
}

#[track_caller]
fn log_of(outcome: &Outcome) -> String {
    let path = outcome.err.split("all of them: ").nth(1).expect("a path of a log").trim();
    let log = fs::read_to_string(path).expect("the log");
    fs::remove_file(path).expect("the log can be removed");
    log
}

#[test]
fn cameras_are_what_colmap_found() {
    let (folder, truth) = place();
    for (name, version, options) in [("three", "3.8", OPTIONS_3), ("four", "4.1.0", OPTIONS_4)] {
        let features = "echo 'Processed file [1/4]'; ls -R \"$images\"";
        colmap(&folder, name, version, options, [features, "", COPIES]);
        whole_model(&folder, name, &truth);
        let line = format!("cameras @/place/images --colmap @/{name} -o @/place/transforms.json --json");
        let outcome = folder.run(&line);
        assert!(!outcome.err.contains("lens distortion"), "{}", outcome.err);
        let json = outcome.json();
        assert_eq!((json["registered"].as_u64(), json["points"].as_u64()), (Some(4), Some(5)), "{json}");
        assert_eq!(json["program"], format!("COLMAP {version}"));
        let found = folder.capture("place");
        for (found, truth) in found.frames.iter().zip(&truth) {
            assert_eq!(found.name, truth.name);
            let (pose, expected) = (found.camera.pose, truth.camera.pose);
            assert!(pose.translation.abs_diff_eq(expected.translation, 1e-9), "{pose:?} and {expected:?}");
            assert!(pose.rotation.abs_diff_eq(expected.rotation, 1e-9), "{pose:?} and {expected:?}");
            let lens = found.lens.expect("a lens that distorts");
            assert_eq!(lens.intrinsics.fx, truth.camera.intrinsics.fx);
            assert!(format!("{:?}", lens.distortion).contains("-0.05"), "{lens:?}");
        }
        assert_eq!(found.frames.len(), 4);
        let cloud = read_points(found.points.expect("points beside the cameras")).expect("points");
        assert_eq!((cloud.positions[4], cloud.colors[4]), ([4.0, 2.0, 3.5], [10, 20, 30]));
        let log = folder.text("place/colmap.log");
        assert!(log.contains("Processed file [1/4]") && log.contains("000003.png"), "{log}");
        folder.run(&line).success();
    }
    let (three, four) = (args(&folder, "three"), args(&folder, "four"));
    assert!(three.contains("--SiftExtraction.use_gpu 0") && three.contains("--SiftMatching.use_gpu 0"), "{three}");
    assert!(four.contains("--FeatureExtraction.use_gpu 0") && four.contains("--FeatureMatching.use_gpu 0"), "{four}");
    assert!(!three.contains("--Feature") && !four.contains("--Sift"), "{three}{four}");
    for (args, counted) in [(&three, "images"), (&four, "frames")] {
        let ratio = format!("_tracks 0 --Mapper.ba_global_{counted}_ratio 1.1");
        assert!(args.contains(&ratio) && args.contains("tolerance 0\n"), "{args}");
    }
    assert!(three.lines().all(|line| line.starts_with("offscreen ")), "{three}");
    folder.run("cameras @/place/images --colmap @/three --matching sequential -o @/video.json").success();
    let video = args(&folder, "three");
    let words = "_tracks 1 --Mapper.ba_global_images_ratio 1.4 --Mapper.ba_global_function_tolerance 0.00001\n";
    assert!(video.contains(words), "{video}");
    folder.write("place/points.ply", "another's");
    let line = "cameras @/place/images --colmap @/three -o @/place/transforms.json";
    folder.run(line).fails(3, &["file to replace", "points.ply", "--overwrite"]);
    folder.run("cameras @/place/images -o @/place/cameras.txt").fails(3, &["cameras.txt", ".json"]);
}

#[test]
fn pycolmap_takes_the_same_steps() {
    let (folder, truth) = place();
    let text = format!(
        "#!/bin/sh
[ \"$1\" = -c ] || exit 9
[ $# = 2 ] && {{ echo 4.2.1; exit 0; }}
step=$3; out=$5; shift 5
echo \"$step $*\" >>\"$0.args\"
[ $step = cameras ] && {COPIES}
exit 0
"
    );
    folder.script("python", &text);
    whole_model(&folder, "python", &truth);
    let run = |options: &str| {
        folder.run(&format!("cameras @/place/images --python @/python {options} -o @/garden.json --json")).json()
    };
    assert_eq!(run("")["program"], "pycolmap 4.2.1");
    assert!(folder.path("garden.points.ply").exists() && folder.path("garden.colmap.log").exists());
    run("--matching sequential --matching-size 800");
    let args = args(&folder, "python");
    assert_eq!(
        args,
        "features 1600 8192\nall \ncameras 0 16 100 30 1 0 1.1 0 5\n\
         features 800 8192\nnear \ncameras 0 16 100 30 1 1 1.4 0.00001 2\n"
    );
}

#[test]
fn the_largest_group_is_taken_and_lost_photos_are_named() {
    let (folder, truth) = place();
    colmap(&folder, "groups", "3.8", OPTIONS_3, ["", "", COPIES]);
    model(&folder.path("groups.model/0"), &[("0/000001.png", &truth[1].camera)]);
    let rest = [("0/000003.png", &truth[3].camera), ("0/000000.png", &truth[0].camera)];
    model(&folder.path("groups.model/1"), &rest);
    model(&folder.path("groups.model/2"), &rest[..1]);
    let text = folder.run("cameras @/place/images --colmap @/groups -o @/place/transforms.json").success();
    for words in [
        "2 of 4 photos",
        "the best of 3 attempts",
        "without a camera: 001.png, 002.png",
        "of them groups of 1 see something of their own",
    ] {
        assert!(text.contains(words), "'{words}' is not in {text}");
    }
    let names: Vec<String> = folder.capture("place").frames.into_iter().map(|f| f.name).collect();
    assert_eq!(names, ["images/000.png", "images/003.png"]);
}

#[test]
fn photos_of_one_size_share_a_lens_and_folders_lie_in_folders() {
    let folder = Folder::new();
    for (name, width) in [("photos/a/1.png", 40), ("photos/a/b/2.png", 60)] {
        folder.make(name.rsplit_once('/').expect("a folder").0);
        crate::photo(width, 30, 1).save_png(folder.path(name)).expect("a photo");
    }
    colmap(&folder, "lists", "3.8", OPTIONS_3, ["(cd \"$images\" && echo */*) >\"$0.seen\"", "", COPIES]);
    let camera = zipsplat_tests::scenes::camera;
    model(&folder.path("lists.model/0"), &[("0/000001.png", &camera(40, 30)), ("1/000003.png", &camera(60, 30))]);
    let line = "cameras @/photos --recursive --colmap @/lists -o @/transforms.json";
    folder.run(line).success();
    let seen = folder.text("lists.seen");
    assert_eq!(seen.trim(), "0/000000.png 0/000001.png 0/000002.png 1/000003.png");
    let names: Vec<String> = folder.capture("transforms.json").frames.into_iter().map(|f| f.name).collect();
    assert_eq!(names, ["photos/10.png", "photos/a/b/2.png"]);
    model(&folder.path("lists.model/0"), &[("0/000001.png", &camera(30, 40))]);
    folder.run(line).fails(3, &["10.png", "30x40", "40x30, as the photo is stored"]);
}

#[test]
fn what_goes_wrong_is_said_and_leaves_nothing() {
    let (folder, truth) = place();
    let found =
        "echo 'Features:        2000'; echo 'Features:        1900'; echo 'Features:        2100'; echo 'Features: 9'";
    let fails = "echo 'ERROR: failed to create sparse model'; exit 1";
    colmap(&folder, "few", "3.8", OPTIONS_3, ["echo '  Features:        17'", "", fails]);
    let none = "echo 'Loading matches... 0 in 0.000s'; echo 'ERROR: failed to create sparse model'; exit 1";
    colmap(&folder, "strangers", "3.8", OPTIONS_3, [found, "", none]);
    let turn = "echo 'Loading matches... 5 in 0.000s'; echo '  => No good initial image pair found.'; exit 1";
    colmap(&folder, "turn", "4.0", OPTIONS_4, [found, "", turn]);
    colmap(&folder, "empty", "4.0", OPTIONS_4, [found, "echo 'Loading matches... 5 in 0.000s'", "exit 0"]);
    colmap(&folder, "fails", "3.8", OPTIONS_3, ["", "echo 'Check failed: empty' >&2; exit 3", COPIES]);
    colmap(&folder, "killed", "3.8", OPTIONS_3, ["", "", "mkdir \"$out/0\"; kill -9 $$"]);
    colmap(&folder, "full", "3.8", OPTIONS_3, [found, "echo 'SQLite error: database or disk is full'", COPIES]);
    folder.script("other", "#!/bin/sh\necho 'usage: other'\n");
    folder.script(
        "python",
        "#!/bin/sh\necho 'Traceback'; echo \"ModuleNotFoundError: No module named 'pycolmap'\" >&2\nexit 1\n",
    );
    folder.write("killed.model", "");
    assert_eq!(truth.len(), 4);
    let line = |option: &str| format!("cameras @/place/images {option} -o @/transforms.json");
    let install = "install";
    let left = |folder: &Folder| -> Vec<String> {
        folder.names().into_iter().filter(|name| !name.ends_with(".args")).collect()
    };
    let before = left(&folder);
    for (option, code, words) in [
        ("--colmap @/absent", 3, ["absent: No such file", install, "pip install pycolmap"]),
        ("--colmap @/other", 3, ["other: says no version", "usage: other", install]),
        ("--python @/python", 3, ["No module named 'pycolmap'", install, "--python"]),
        ("--colmap @/few", 3, ["cameras of 4 photos", "17 in the median photo", "sharp"]),
        ("--colmap @/strangers", 3, ["none", "no two of them show the same", "photos of one place"]),
        ("--colmap @/turn", 3, ["5 of 6 pairs", "far enough apart", "not only a turn"]),
        ("--colmap @/empty", 3, ["cameras of 4 photos", "5 of 6 pairs", "far enough apart"]),
        ("--colmap @/fails", 1, ["could not match photos", "exit status: 3", "Check failed"]),
        ("--colmap @/full", 1, ["no room left", "TMPDIR", ""]),
        ("--colmap @/killed", 1, ["could not find cameras", "signal: 9", "all of them"]),
    ] {
        let outcome = folder.run(&line(option));
        if outcome.err.contains("all of them") {
            let log = log_of(&outcome);
            assert!(option.ends_with("killed") || log.contains("Check failed"), "{log}");
        }
        outcome.fails(code, &words);
        assert_eq!(left(&folder), before, "{option}");
    }
    folder.run("cameras @/place/images/000.png --colmap @/few -o @/c.json").fails(3, &["two or more"]);
    folder.run("cameras @/place/images --colmap @/few --python @/python -o @/c.json").fails_usage();
}

#[test]
fn a_model_of_other_photos_is_refused() {
    let (folder, truth) = place();
    colmap(&folder, "other", "3.8", OPTIONS_3, ["", "", COPIES]);
    model(&folder.path("other.model/0"), &[("elsewhere.png", &truth[0].camera), ("b.png", &truth[1].camera)]);
    let line = "cameras @/place/images --colmap @/other -o @/transforms.json";
    folder.run(line).fails(3, &["model of COLMAP 3.8", "png, which is none of the photos"]);
}

#[test]
fn other_commands_find_cameras_too() {
    let (folder, truth) = place();
    colmap(&folder, "colmap", "3.8", OPTIONS_3, ["", "", COPIES]);
    whole_model(&folder, "colmap", &truth);
    let find = "--cameras colmap --colmap @/colmap";
    let micro = "--weights @/micro.safetensors --input-size 28x28";
    let line =
        format!("reconstruct @/place/images {find} {micro} --cameras-out @/place/found.json -o @/scene.ply --json");
    let outcome = folder.run(&line);
    assert!(outcome.err.contains("cameras found: 4 of 4 photos, 5 points, by COLMAP 3.8"), "{}", outcome.err);
    assert_eq!(outcome.json()["photos"], 4);
    let scene = Scene::open(folder.path("scene.ply")).expect("a scene");
    let refined = format!(
        "reconstruct @/place/images --refine=1 --world input-cameras --colmap @/colmap {micro} -o @/r.ply --json"
    );
    assert_eq!(folder.run(&refined).json()["refined"]["steps"], 1);
    let again = format!("reconstruct @/place/images --cameras @/place/found.json {micro} -o @/scene.ply");
    folder.run(&again).success();
    assert!(
        Scene::open(folder.path("scene.ply")).expect("a scene") == scene,
        "other cameras than those that were kept"
    );
    folder
        .run(&format!("{again} --cameras-out @/c.json"))
        .fails(3, &["--cameras-out", "--cameras colmap, --optimize-cameras, or no --cameras"]);
    let eval = folder.run(&format!("eval @/place/images --views 3 {find} {micro} --json")).json();
    assert_eq!(
        (&eval["scene_scale_source"], eval["views"].as_array().map(Vec::len)),
        (&"points".into(), Some(1)),
        "{eval}"
    );
    let line = format!("refine @/place/images {find} --init points --steps 2 -o @/refined.ply --json");
    assert_eq!(folder.run(&line).json()["photos"], 4);
    folder
        .run(&format!("refine @/scene.ply @/place/images {find} -o @/r.ply"))
        .fails(3, &["--cameras colmap", "--init points"]);
}

pub fn installed(program: &str, test: &str) -> bool {
    let runs = std::process::Command::new(program).arg("help").output().is_ok();
    if !runs {
        eprintln!("{test} is skipped: {program} is not installed");
    }
    runs
}

#[test]
fn colmap_itself_finds_the_cameras_of_a_place() {
    if !installed("colmap", "colmap_itself_finds_the_cameras_of_a_place") {
        return;
    }
    let folder = Folder::new();
    folder.run("scene --seed 3 --views 16 --size 640x480 -o @/place").success();
    // COLMAP is random: a photo may be lost, rarely a whole model is bent.
    let mut tries = (0..3).map(|_| {
        let json = folder.run("cameras @/place/images -o @/place/found.json --json").json();
        let found = folder.capture("place/found.json");
        let points = read_points(found.points.expect("points")).expect("points").positions.len();
        let (angle, scale) = deviations(&found.frames, &folder.capture("place").frames);
        let right = json["registered"].as_u64() >= Some(12) && points > 50 && angle < 1.0 && scale < 0.05;
        if right { Ok(()) } else { Err(format!("{json}, {points} points, {angle} degrees, {scale} in distances")) }
    });
    let first = tries.next().expect("a try");
    first.or_else(|why| tries.find_map(Result::ok).ok_or(why)).expect("cameras near the true ones");
}

/// Median deviations over pairs of cameras: degrees, and distances relative to their median.
fn deviations(found: &[CaptureView], truth: &[CaptureView]) -> (f64, f64) {
    let stem = |frame: &CaptureView| Path::new(&frame.name).file_stem().map(ToOwned::to_owned);
    let true_camera =
        |frame: &CaptureView| truth.iter().find(|other| stem(other) == stem(frame)).expect("a photo").camera;
    let cameras: Vec<[Camera; 2]> = found.iter().map(|frame| [frame.camera, true_camera(frame)]).collect();
    let (mut angles, mut scales) = (Vec::new(), Vec::new());
    for (i, one) in cameras.iter().enumerate() {
        for other in &cameras[..i] {
            let [found, truth] = [0, 1].map(|k| one[k].pose.relative_to(&other[k].pose));
            let turn = (found.rotation.transpose() * truth.rotation).to_cols_array();
            angles.push(((turn[0] + turn[4] + turn[8] - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees());
            scales.push(found.translation.length() / truth.translation.length());
        }
    }
    let median = |values: Vec<f64>| median(values).unwrap_or(f64::NAN);
    let scale = median(scales.clone());
    (median(angles), median(scales.iter().map(|other| (other / scale - 1.0).abs()).collect()))
}

#[test]
fn progress_is_printed_without_a_terminal() {
    let (folder, _) = place();
    colmap(&folder, "slow", "3.8", OPTIONS_3, ["sleep 8; exit 1", "", ""]);
    let out = child("cameras::takes_long", folder.0.path(), "").output().expect("bash");
    let err = String::from_utf8_lossy(&out.stderr);
    assert!(err.lines().any(|line| line.starts_with("find features: ") && line.ends_with(" so far")), "{err}");
}

#[test]
#[ignore = "child of the other tests"]
fn takes_long() {
    let Some(folder) = target() else { return };
    let line = "zipsplat cameras @/place/images --colmap @/slow -o @/transforms.json";
    let args = line.replace('@', &folder.display().to_string());
    let args = args.split(' ').map(OsString::from);
    let (mut out, mut err) = (Vec::new(), Vec::new());
    run(args, Terminal { out: &mut out, err: &mut err, progress: true, cancelled: &AtomicBool::new(false) });
}
