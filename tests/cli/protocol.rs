use crate::Folder;
use glam::{DMat3, DVec3};
use serde_json::{Value, json};
use std::path::PathBuf;
use zipsplat::stages::lpips::LpipsNetwork;
use zipsplat::types::{Pose, poses::CaptureView, quaternion_from_matrix, read_ply, write_ply};
use zipsplat_tests::golden::lpips_weights;

/// As in images_4.
const SMALLER: u32 = 4;
/// Of the tangent: a fisheye lens close to a pinhole.
const STRAIGHT: [f64; 4] = [1.0 / 3.0, 2.0 / 15.0, 17.0 / 315.0, 62.0 / 2835.0];
const OPTIONS: &str = "--weights @/micro.safetensors --input-size 28x28 --lpips none";

fn place(folder: &Folder, seed: u32) -> Vec<CaptureView> {
    folder.run(&format!("scene --seed {seed} --views 12 --size 84x56 -o @/place")).success();
    folder.capture("place").frames
}

fn copy(folder: &Folder, to: &str, frames: &[CaptureView], name: impl Fn(usize) -> String) {
    folder.make(to);
    for (i, frame) in frames.iter().enumerate() {
        let photo = frame.photo.as_ref().expect("a photo");
        std::fs::copy(photo, folder.path(to).join(name(i))).expect("copied");
    }
}

/// Full-resolution intrinsics at the top, OpenGL axes, names in images/, photos in images_4/.
fn dl3dv(folder: &Folder, scene: &str, frames: &[CaptureView], k1: f64) {
    copy(folder, &format!("{scene}/images_4"), frames, |i| format!("frame_{i:05}.png"));
    let lens = frames[0].camera.intrinsics;
    let times = f64::from(SMALLER);
    let rows = |Pose { rotation: r, translation: t }: Pose| {
        [0, 1, 2].map(|i| json!([r.x_axis[i], -r.y_axis[i], -r.z_axis[i], t[i]]))
    };
    let frame = |(i, frame): (usize, &CaptureView)| {
        let [a, b, c] = rows(frame.camera.pose);
        json!({"file_path": format!("images/frame_{i:05}.png"), "transform_matrix": [a, b, c, [0.0, 0.0, 0.0, 1.0]], "colmap_im_id": i})
    };
    let cameras = json!({
        "w": lens.width * SMALLER, "h": lens.height * SMALLER, "fl_x": lens.fx * times, "fl_y": lens.fy * times,
        "cx": lens.cx * times, "cy": lens.cy * times, "k1": k1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV",
        "frames": frames.iter().enumerate().map(frame).collect::<Vec<_>>(),
    });
    folder.write(&format!("{scene}/transforms.json"), cameras.to_string());
}

/// A URL, then lines of microseconds, relative intrinsics, two zeros, world-to-camera.
fn re10k(folder: &Folder, scene: &str, frames: &[CaptureView]) {
    copy(folder, scene, frames, |i| format!("{}.png", 33_367 * (i + 1)));
    let mut text = "https://www.youtube.com/watch?v=none\n".to_owned();
    for (i, CaptureView { camera, .. }) in frames.iter().enumerate() {
        let (lens, pose) = (camera.intrinsics, camera.pose.inverse());
        let [w, h] = [lens.width, lens.height].map(f64::from);
        text += &format!("{} {} {} {} {} 0 0", 33_367 * (i + 1), lens.fx / w, lens.fy / h, lens.cx / w, lens.cy / h);
        let (r, t) = (pose.rotation, pose.translation);
        (0..3).for_each(|k| text += &format!(" {} {} {} {}", r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]));
        text += "\n";
    }
    folder.write(&format!("{scene}.txt"), &text);
}

fn colmap(folder: &Folder, model: &str, frames: &[CaptureView], camera: &str, name: impl Fn(usize) -> String) {
    folder.write(&format!("{model}/cameras.txt"), format!("# one\n1 {camera}\n"));
    let mut images = String::new();
    for (i, frame) in frames.iter().enumerate() {
        let pose = frame.camera.pose.inverse();
        let ([w, x, y, z], t) = (quaternion_from_matrix(&pose.rotation), pose.translation);
        images += &format!("{} {w} {x} {y} {z} {} {} {} 1 {}\n\n", i + 1, t.x, t.y, t.z, name(i));
    }
    folder.write(&format!("{model}/images.txt"), &images);
}

/// A full-resolution pinhole, photos in images_4/.
fn mipnerf360(folder: &Folder, scene: &str, frames: &[CaptureView]) {
    let name = |i: usize| format!("_DSC{:04}.JPG", 8000 + i);
    copy(folder, &format!("{scene}/images_4"), frames, name);
    let lens = frames[0].camera.intrinsics;
    let [fx, fy, cx, cy] = [lens.fx, lens.fy, lens.cx, lens.cy].map(|value| value * f64::from(SMALLER));
    let camera = format!("PINHOLE {} {} {fx} {fy} {cx} {cy}", lens.width * SMALLER, lens.height * SMALLER);
    colmap(folder, &format!("{scene}/sparse/0"), frames, &camera, name);
}

/// A fisheye lens, photos in dslr/resized_images/.
fn scannetpp(folder: &Folder, scene: &str, frames: &[CaptureView], [k1, k2, k3, k4]: [f64; 4]) {
    let name = |i: usize| format!("DSC{i:05}.JPG");
    copy(folder, &format!("{scene}/dslr/resized_images"), frames, name);
    let lens = frames[0].camera.intrinsics;
    let size = format!("{} {} {} {} {} {}", lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy);
    let camera = format!("OPENCV_FISHEYE {size} {k1} {k2} {k3} {k4}");
    colmap(folder, &format!("{scene}/dslr/colmap"), frames, &camera, name);
}

fn figures(json: &Value) -> [f64; 3] {
    let [row] = &json["scenes"].as_array().expect("rows")[..] else { panic!("not one row: {json}") };
    assert_eq!(row["scene"], "one");
    ["psnr", "ssim", "gaussians"].map(|name| row[name].as_f64().expect("a number"))
}

#[test]
fn every_layout_gives_the_same_figures() {
    let folder = Folder::new();
    let frames = place(&folder, 5);
    dl3dv(&folder, "dl3dv/one", &frames, 0.0);
    dl3dv(&folder, "bent/one", &frames, 0.3);
    re10k(&folder, "re10k/one", &frames);
    mipnerf360(&folder, "mipnerf360/one", &frames);
    scannetpp(&folder, "scannetpp/one", &frames, STRAIGHT);
    scannetpp(&folder, "fisheye/one", &frames, [0.0; 4]);
    folder.write("frames.json", r#"{"one": {"context": [1, 4, 9], "target": [0, 2, 9], "overlap": 0.5}, "two": null}"#);
    let run = |protocol: &str, data: &str, options: &str| {
        let out = format!("out-{data}-{}", options.len());
        let line = format!("eval @/{data} --protocol {protocol} {OPTIONS} {options} --align none -o @/{out} --json");
        figures(&folder.run(&line).json())
    };
    for options in ["--indices @/frames.json", "--views 3 --frame-range 8 --targets 4"] {
        let [psnr, ssim, gaussians] = run("dl3dv", "dl3dv", options);
        for protocol in ["re10k", "mipnerf360", "scannetpp"] {
            let found = run(protocol, protocol, options);
            let same = (found[0] - psnr).abs() < 2e-3 && (found[1] - ssim).abs() < 2e-4 && found[2] == gaussians;
            assert!(same, "{protocol} {options}: {found:?}, as DL3DV {:?}", [psnr, ssim, gaussians]);
        }
    }
    let options = "--indices @/frames.json";
    let [straight, bent, kept, fisheye] = [
        run("dl3dv", "dl3dv", options),
        run("dl3dv", "bent", options),
        run("dl3dv", "bent", &format!("{options} --keep-distortion")),
        run("scannetpp", "fisheye", options),
    ]
    .map(|[psnr, ..]| psnr);
    assert!((straight - bent).abs() > 1e-2 && (straight - fisheye).abs() > 1e-2, "{straight}, {bent}, {fisheye} dB");
    assert!((straight - kept).abs() < 2e-3, "{straight} and {kept} dB");
    let line = format!("eval @/fisheye --protocol scannetpp {OPTIONS} {options} --keep-distortion -o @/x");
    let outcome = folder.run(&line);
    assert!(outcome.code == 1 && outcome.err.contains("almost pinholes"), "{}", outcome.err);
}

fn two_scenes(folder: &Folder) {
    for (scene, seed) in [("data/one", 5), ("data/two", 6)] {
        dl3dv(folder, scene, &place(folder, seed), 0.0);
    }
}

const SERIES: &str = "eval @/data --protocol dl3dv --views 2,3 --frame-range 6,8 --targets 2 --align none -o @/out";

#[test]
fn a_series_keeps_what_was_done() {
    let folder = Folder::new();
    two_scenes(&folder);
    let line = format!("{SERIES} {OPTIONS}");
    let first = folder.run(&format!("{line} --limit 3 --json")).json();
    assert_eq!((&first["evaluated"], &first["skipped"]), (&json!(3), &json!(0)));
    let all = folder.run(&format!("{line} --json")).json();
    assert_eq!((&all["evaluated"], &all["skipped"]), (&json!(1), &json!(3)));
    let rows = all["scenes"].as_array().expect("rows");
    assert_eq!(rows.len(), 4);
    let of =
        |views: u64| rows.iter().filter(move |row| row["views"] == views).map(|row| row["psnr"].as_f64().expect("dB"));
    let headings = "| Method | P | K | 2v scenes | 2v #Gs | 2v PSNR | 2v SSIM | 2v LPIPS | 3v scenes | 3v #Gs | 3v PSNR | 3v SSIM | 3v LPIPS |";
    let table = folder.text("out/table.md");
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!((lines[2], lines[3], lines.len()), ("", headings, 6), "{table}");
    let cells: Vec<&str> = lines[5].trim_matches('|').split('|').map(str::trim).collect();
    let mean = |views| of(views).sum::<f64>() / 2.0;
    let [two, three] = [mean(2), mean(3)].map(|psnr| format!("{psnr:.2}"));
    assert_eq!(cells[..6], ["micro", "✓", "✓", "2", "32", &two], "{table}");
    assert_eq!(cells[8..11], ["2", "48", &three], "{table}");
    let csv = folder.text("out/table.csv");
    assert!(csv.starts_with("Method,P,K,2v scenes,2v #Gs") && csv.contains(&format!("2,32,{two}")), "{csv}");
    let scenes = folder.text("out/scenes.csv");
    assert_eq!(scenes.lines().count(), 5, "{scenes}");
    let page = folder.text("out/page.html");
    assert!(page.matches("src=\"data:image/jpeg;base64,").count() == 4 && !page.contains("http"), "no picture a row");
    let free = folder.run(&format!("{line} --pose-free --name A|B --json")).json();
    assert_eq!((&free["evaluated"], free["means"].as_array().map(Vec::len)), (&json!(4), Some(2)));
    let photo = folder.path("data/two/images_4/frame_00000.png");
    std::fs::copy(folder.path("data/two/images_4/frame_00001.png"), &photo).expect("copied");
    let again = folder.run(&format!("{line} --json")).json();
    assert_eq!((&again["evaluated"], &again["skipped"]), (&json!(2), &json!(2)));
}

#[test]
fn a_protocol_aligns_cameras() {
    let folder = Folder::new();
    folder.run("scene --seed 9 --views 12 --size 84x56 --splats -o @/place").success();
    dl3dv(&folder, "data/one", &folder.capture("place").frames, 0.0);
    let mut scene = read_ply(folder.path("place/splats.ply")).expect("a scene");
    scene.place(1.0, &Pose { rotation: DMat3::from_rotation_y(0.03), translation: DVec3::new(0.02, 0.0, 0.01) });
    folder.make("scenes");
    write_ply(&scene, folder.path("scenes/one.ply")).expect("written");
    let line =
        format!("eval @/data --protocol dl3dv --scene @/scenes --views 2 --frame-range 4 --targets 1 {OPTIONS} --json");
    let figure = |options: &str, out: &str| figures(&folder.run(&format!("{line} {options} -o @/{out}")).json())[0];
    let [usual, adam, none] = [figure("", "a"), figure("--align adam", "b"), figure("--align none", "c")];
    assert!(usual == adam && usual > none + 1.0, "{usual}, {adam} and {none} dB");
    folder.run(&format!("{line} --align hope -o @/d")).fails_usage();
    let by_default = format!("{} --align none -o @/e", line.replace("--lpips none", "").replace("--json", ""));
    match lpips_weights(LpipsNetwork::Vgg) {
        Some(_) => drop(folder.run(&by_default).success()),
        None => folder.run(&by_default).fails(3, &["--lpips", "lpips_vgg.safetensors", "--lpips none"]),
    };
    std::fs::rename(folder.path("scenes/one.ply"), folder.path("scenes/two.ply")).expect("renamed");
    let outcome = folder.run(&format!("{line} -o @/d"));
    assert!(outcome.code == 1 && outcome.err.contains("one.ply"), "{}", outcome.err);
}

#[test]
fn rows_depend_on_the_content_of_the_weights() {
    let folder = Folder::new();
    two_scenes(&folder);
    let line = format!("{SERIES} {OPTIONS} --json");
    assert_eq!(folder.run(&line).json()["evaluated"], 4);
    let mut bytes = folder.read("micro.safetensors");
    std::fs::write(folder.path("micro.safetensors"), &bytes).expect("written");
    assert_eq!(folder.run(&line).json()["skipped"], 4);
    *bytes.last_mut().expect("a byte") ^= 1;
    std::fs::write(folder.path("micro.safetensors"), &bytes).expect("written");
    assert_eq!(folder.run(&line).json()["evaluated"], 4);
}

#[test]
fn several_ratios_and_selections_are_rows_of_their_own() {
    let folder = Folder::new();
    two_scenes(&folder);
    let line = format!("{SERIES} {OPTIONS} --limit 100 --json");
    let one = folder.run(&format!("{line} --ratio 0.5 --token-selection stride")).json();
    let json = folder.run(&format!("{line} --ratios 1,0.5 --token-selections mutual,stride")).json();
    let means = json["means"].as_array().expect("means");
    let line_of = |name: &str| means.iter().find(|line| line[0] == name).unwrap_or_else(|| panic!("{name}: {json}"));
    for name in ["micro r=1 mutual", "micro r=1 stride", "micro r=0.5 mutual", "micro r=0.5 stride"] {
        assert_eq!(line_of(name)[4], if name.contains("0.5") { "16" } else { "32" }, "{name}");
    }
    let cells = |line: &Value| line.as_array().expect("cells")[1..].to_vec();
    assert_eq!(cells(&one["means"][0]), cells(line_of("micro r=0.5 stride")));
    assert_eq!(json["evaluated"], 16);
    folder.run(&format!("{SERIES} {OPTIONS} --ratio 1 --ratios 1")).fails_usage();
}

/// Scenes missing from the index file are counted per variant.
#[test]
fn ratios_of_pixels_are_rows_of_their_own() {
    let folder = Folder::new().with_depth();
    two_scenes(&folder);
    folder.write("frames.json", r#"{"one": {"context": [1, 4], "target": [0]}}"#);
    let options = "--weights @/da3.safetensors --input-size 42x28 --lpips none --align none --name depth";
    let line = format!("eval @/data --protocol dl3dv --indices @/frames.json {options} --ratios 1,0.5 -o @/out --json");
    let json = folder.run(&line).json();
    assert_eq!((&json["evaluated"], &json["unknown"]), (&json!(2), &json!(2)));
    let rows = json["scenes"].as_array().expect("rows");
    let gaussians = |method: &str| {
        let row = rows.iter().find(|row| row["method"] == method).unwrap_or_else(|| panic!("{method}: {json}"));
        row["gaussians"].as_u64().expect("a number")
    };
    assert!(gaussians("depth r=0.5") < gaussians("depth r=1"), "{json}");
    for (options, evaluated) in [("", 0), ("--per-view-focal", 2), ("--block-size 3", 2)] {
        assert_eq!(folder.run(&format!("{line} {options}")).json()["evaluated"], evaluated, "{options}");
    }
}

#[test]
fn filter_and_source_size_are_those_of_tables_5_and_6() {
    let folder = Folder::new();
    place(&folder, 5);
    let line =
        "eval @/place --views 2 --targets 2 --weights @/micro.safetensors --input-size 28x28 --lpips none --json";
    let run = |options: &str, out: &str| {
        let json = folder.run(&format!("{line} {options} -o @/{out}")).json();
        (json["mean"]["psnr"].as_f64().expect("dB"), folder.read(&format!("{out}/scene.ply")))
    };
    let [usual, lanczos, bilinear, source] = [
        run("", "a"),
        run("--filter lanczos", "b"),
        run("--filter bilinear", "c"),
        run("--filter lanczos --source-side 40", "d"),
    ];
    assert_eq!(usual, lanczos);
    assert!(bilinear.0 != lanczos.0 && bilinear.1 == lanczos.1);
    assert!(source.0 != lanczos.0 && source.1 != lanczos.1);
    folder.run("scene --seed 9 --views 8 --size 84x56 --splats -o @/exact").success();
    let exact = "eval @/exact --scene @/exact/splats.ply --views 2 --input-size 28x28 --lpips none --json";
    let figure = |options: &str| folder.run(&format!("{exact} {options}")).json()["mean"]["psnr"].as_f64().expect("dB");
    let [whole, smaller] = [figure(""), figure("--source-side 40")];
    assert!(smaller > whole - 1.0, "{whole} and {smaller} dB");
}

#[test]
fn tokens_are_refined_until_they_converge() {
    let folder = Folder::new();
    dl3dv(&folder, "data/one", &place(&folder, 5), 0.0);
    let line = format!("{SERIES} {OPTIONS} --refine 2 --refine-target tokens --json");
    let few = folder.run(&line).json();
    let converged = folder.run(&format!("{line} --converge")).json();
    let names: Vec<&Value> = converged["means"].as_array().expect("means").iter().map(|line| &line[0]).collect();
    assert!(names.contains(&&json!("micro + TTO")) && names.contains(&&json!("micro + TTO, converged")), "{names:?}");
    assert_eq!((&few["evaluated"], &converged["evaluated"]), (&json!(2), &json!(2)));
    let points = "eval @/place --views 3 --weights @/micro.safetensors --input-size 28x28 --lpips none --json";
    let steps = |options: &str| {
        folder.run(&format!("{points} --refine 2 --init points {options}")).json()["refined"]["steps"].clone()
    };
    assert_eq!(steps(""), 2);
    assert!(steps("--converge").as_u64().is_some_and(|steps| steps >= 8 && steps.is_power_of_two()));
    folder.run("eval @/data/one --views 2 --refine 1s --converge").fails(3, &["--converge", "a number of steps"]);
}

#[test]
fn scenes_that_fail_are_listed() {
    let folder = Folder::new();
    two_scenes(&folder);
    folder.remove("data/one/images_4/frame_00000.png");
    folder.write(
        "frames.json",
        r#"{"one": {"context": [0, 3], "target": [1]}, "two": {"context": [0, 3], "target": [1]}}"#,
    );
    let line = format!("eval @/data --protocol dl3dv {OPTIONS} --align none --indices @/frames.json -o @/out");
    let outcome = folder.run(&format!("{line} --json"));
    assert!(outcome.code == 1 && outcome.err.contains("photo of frame 0 of one"), "{}", outcome.err);
    let failures = folder.text("out/failures.csv");
    assert!(failures.lines().count() == 2 && failures.contains("one"), "{failures}");
    let table = folder.text("out/table.csv");
    assert!(table.lines().count() == 2, "the other scene counts: {table}");

    let refuses = |text: &str, words: &[&str]| {
        folder.write("frames.json", text);
        folder.run(&line).fails(3, words);
    };
    refuses("[]", &["frames.json", "map"]);
    refuses("{}", &["frames.json", "no scene"]);
    refuses(r#"{"one": {"context": [], "target": [1]}}"#, &["one", "0 of context"]);
    let uneven = r#"{"one": {"context": [0], "target": [1]}, "two": {"context": [0, 1], "target": [2]}}"#;
    refuses(uneven, &["two", "found 2 of context, expected 1"]);
    refuses(r#"{"three": {"context": [0], "target": [1]}}"#, &["--indices", "none of the scenes"]);
    folder
        .run("eval @/photos --protocol re10k --lpips none -o @/out2")
        .fails(3, &["scene of RealEstate10K", "camera file"]);
    folder
        .run("eval @/data @/data/one --protocol dl3dv --lpips none -o @/out2")
        .fails(3, &["scene one", "one of this name"]);
    folder.run("eval @/data --protocol dl3dv").fails_usage();
    folder.run("eval @/data --frame-range 50").fails_usage();
    folder.run("eval @/data @/photos @/data").fails(3, &["folders", "one capture"]);
    folder.run("eval @/data/one --views 2,3").fails(3, &["--views", "one number"]);
    assert!(!folder.path("out2").exists());
}

#[test]
fn other_folders_of_photos_are_taken_where_asked() {
    let folder = Folder::new();
    let frames = place(&folder, 5);
    mipnerf360(&folder, "mip/one", &frames);
    let [from, to]: [PathBuf; 2] = ["mip/one/images_4", "mip/one/small"].map(|path| folder.path(path));
    std::fs::rename(from, to).expect("renamed");
    let line = format!("eval @/mip/one --protocol mipnerf360 --views 2 --targets 1 {OPTIONS} --align none -o @/out");
    let outcome = folder.run(&line);
    assert!(outcome.code == 1 && outcome.err.contains("frames of one"), "{}", outcome.err);
    folder.run(&format!("{line} --images small")).success();
}
