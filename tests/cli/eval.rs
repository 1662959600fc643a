use crate::{Folder, zipsplat};
use glam::{DMat3, DVec3};
use zipsplat::{
    Error,
    gpu::Arena,
    stages::render::{RenderOptions, Renderer},
    types::{Camera, Image, Intrinsics, Pose, poses::write_colmap, read_ply},
};
use zipsplat_cli::{
    align::{Doubt, MOST_SHIFT, MOST_TURN, Method, align},
    metrics::{psnr, ssim, values},
};
use zipsplat_tests::device::device;

const WIDTH: usize = 37;
const HEIGHT: usize = 23;

fn picture(value: impl Fn(usize, usize, usize) -> f64) -> Vec<f32> {
    let pixels = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x, y)));
    pixels.flat_map(|(x, y)| [0, 1, 2].map(|c| value(x, y, c) as f32)).collect()
}

/// scikit-image 0.26.0: `structural_similarity` with `win_size=11` and `gaussian_weights=True`.
#[test]
fn metrics_are_those_of_scikit_image() {
    let rough = |k: usize| picture(|x, y, c| ((x * x * 3 + y * (7 + k) + x * y * k + c * 29) % 97) as f64 / 96.0);
    let smooth = picture(|x, y, c| (x + 2 * y + 5 * c) as f64 / (WIDTH + 2 * HEIGHT + 15) as f64);
    let mixed: Vec<f32> = smooth.iter().zip(rough(2)).map(|(a, b)| 0.9 * a + 0.1 * b).collect();
    let gray = vec![0.5; smooth.len()];
    for (a, b, expected) in [
        (&rough(0), &rough(1), [7.821_466, -0.006_084]),
        (&smooth, &mixed, [29.232_437, 0.778_115]),
        (&smooth, &gray, [14.736_981, 0.415_746]),
        (&gray, &gray, [f64::INFINITY, 1.0]),
    ] {
        let found = [psnr(a, b), ssim(a, b, WIDTH, HEIGHT)];
        let alike = |(a, b): (&f64, &f64)| a == b || (a - b).abs() < 1e-5;
        assert!(found.iter().zip(&expected).all(alike), "found {found:?}, expected {expected:?}");
    }
}

fn place() -> Folder {
    let folder = Folder::new();
    folder.run("scene --seed 5 --views 6 --size 42x28 -o @/place").success();
    folder
}

fn inputs(json: &serde_json::Value) -> String {
    let names = json["inputs"].as_array().expect("names").iter();
    let paths: Vec<String> = names.map(|name| format!("@/place/{}", name.as_str().expect("a name"))).collect();
    paths.join(" ")
}

#[test]
fn held_out_photos_are_compared() {
    let folder = place();
    let line =
        "eval @/place --views 2 --weights @/micro.safetensors --input-size 42x28 --csv @/scores.csv -o @/out --json";
    let json = folder.run(line).json();
    let csv = folder.text("scores.csv");
    let lines: Vec<&str> = csv.lines().collect();
    assert_eq!(lines[0], "view,psnr,ssim,nearest_psnr,mean_color_psnr,lpips");
    assert_eq!(lines.len(), 1 + 4, "{csv}");
    let inputs: Vec<&str> = json["inputs"].as_array().expect("names").iter().filter_map(|name| name.as_str()).collect();
    assert_eq!((inputs.len(), inputs[0]), (2, "images/000.png"));
    for (row, line) in lines[1..].iter().enumerate() {
        let cells: Vec<&str> = line.split(',').collect();
        assert!(!inputs.contains(&cells[0]), "{} is an input", cells[0]);
        for (cell, name) in cells[1..].iter().zip(["psnr", "ssim", "nearest_psnr", "mean_color_psnr"]) {
            let (written, reported) = (cell.parse::<f64>().expect("a number"), json["views"][row][name].as_f64());
            assert!(
                reported.is_some_and(|reported| (reported - written).abs() < 1e-3),
                "{name}: {written} and {reported:?}"
            );
        }
    }
    // The capture's scale is the network's, except for points of unused photos.
    assert!(json["scene_scale"].as_f64().is_some_and(|unit| (0.5..2.0).contains(&unit)), "{}", json["scene_scale"]);
    assert_eq!(read_ply(folder.path("out/scene.ply")).expect("a scene").len(), 2 * 6 * 4);
    let picture = Image::open(folder.path("out/comparison.png")).expect("a picture");
    assert_eq!((picture.width, picture.height), (6 * 42, 2 * 28));
}

#[test]
fn the_unit_of_the_cameras_does_not_matter() {
    let folder = place();
    let line = "eval @/place --views 3 --weights @/micro.safetensors --input-size 28x28 --json";
    let mean = |line: &str| folder.run(line).json()["mean"]["psnr"].as_f64().expect("a number");
    let before = mean(line);
    folder.edit_frames("place/transforms.json", |frame| {
        for row in 0..3 {
            let moved = 8.0 * frame["transform_matrix"][row][3].as_f64().expect("a number");
            frame["transform_matrix"][row][3] = moved.into();
        }
    });
    let points = folder.path("place/points.ply");
    let cloud = zipsplat::types::read_points(&points).expect("points").positions;
    let scaled: Vec<_> = cloud.iter().map(|point| (point.map(|value| 8.0 * value), [0; 3])).collect();
    zipsplat::types::write_points(&points, &scaled).expect("written");
    let after = mean(line);
    assert!((before - after).abs() < 1e-3, "{before} dB and {after} dB");
    let wrong = mean(&format!("{line} --scene-scale 1"));
    assert!((before - wrong).abs() > 1e-3, "{before} dB and {wrong} dB");
}

#[test]
fn without_points_the_unit_is_that_of_the_cameras() {
    let folder = place();
    let options = "--weights @/micro.safetensors --input-size 28x28 --json";
    let eval = format!("eval @/place --views 3 {options}");
    let with_points = folder.run(&eval).json();
    assert_eq!(with_points["scene_scale_source"], "points");
    folder.remove("place/points.ply");
    let outcome = folder.run(&eval);
    assert!(outcome.err.contains("no point cloud") && outcome.err.contains("--scene-scale"), "{}", outcome.err);
    let json = outcome.json();
    let unit = json["scene_scale"].as_f64().expect("a number");
    let ratio = unit / with_points["scene_scale"].as_f64().expect("a number");
    assert!((0.4..2.5).contains(&ratio) && unit != 1.0, "{unit}, {ratio} of that of the points");
    assert!(["axes", "spread"].contains(&json["scene_scale_source"].as_str().expect("a word")), "{json}");
    let line = format!("reconstruct {} --cameras @/place {options} -o @/scene.ply", inputs(&json));
    let outcome = folder.run(&line);
    assert!(outcome.err.contains("no point cloud"), "{}", outcome.err);
    let found = outcome.json();
    assert_eq!(
        (&found["scene_scale"], &found["scene_scale_source"]),
        (&json["scene_scale"], &json["scene_scale_source"])
    );
    let mut frames = folder.capture("place").frames;
    frames.iter_mut().for_each(|frame| frame.name = frame.name.replace("images/", ""));
    folder.remove("place/transforms.json");
    folder.make("place/sparse/0");
    write_colmap(folder.path("place/sparse/0"), &frames, &[]).expect("written");
    folder.remove("place/sparse/0/points3D.txt");
    let missing = folder.run(&line).json();
    folder.write("place/sparse/0/points3D.txt", "# no points\n");
    let empty = folder.run(&line).json();
    for json in [missing, empty] {
        assert!((json["scene_scale"].as_f64().expect("a number") / unit - 1.0).abs() < 1e-6, "{}", json["scene_scale"]);
    }
}

#[test]
fn scenes_are_those_of_reconstruct_in_the_unit_of_the_cameras() {
    let folder = place();
    let options = "--weights @/micro.safetensors --input-size 28x28 --scene-scale 3 -o";
    let outcome = folder.run(&format!("eval @/place --views 2 --json {options} @/out"));
    assert!(outcome.err.contains("33 % of the photos' area is cropped away; --crop tiles"), "{}", outcome.err);
    let json = outcome.json();
    folder.run(&format!("reconstruct {} --cameras @/place {options} @/scene.ply", inputs(&json))).success();
    assert!(folder.read("out/scene.ply") == folder.read("scene.ply"), "two scenes of the same photos");
}

#[test]
fn whole_photos_are_compared() {
    let folder = place();
    let line = "eval @/place --views 2 --weights @/micro.safetensors --input-size 28x28 -o @/out";
    let mut scenes = Vec::new();
    for (options, views) in [("--full-images", 2), ("--crop tiles", 4)] {
        let json = folder.run(&format!("{line} {options} --json")).json();
        assert_eq!(json["all_tokens"].as_u64(), Some(views * 4), "{options}");
        let picture = Image::open(folder.path("out/comparison.png")).expect("a picture");
        assert_eq!((picture.width, picture.height), (6 * 42, 2 * 28), "{options}");
        scenes.push(read_ply(folder.path("out/scene.ply")).expect("a scene").len());
    }
    assert_eq!(scenes[1], 2 * scenes[0]);
    folder.run(&format!("{line} --crop tiles --pose-free")).fails(3, &["--crop tiles", "known cameras"]);
}

fn splats(folder: &Folder) -> Renderer {
    folder.run("scene --seed 5 --views 4 --size 84x56 --splats -o @/place").success();
    let mut renderer = Renderer::new(device());
    renderer.set_scene(&read_ply(folder.path("place/splats.ply")).expect("a scene")).expect("loaded");
    renderer
}

#[test]
fn a_camera_stays_near_its_first_estimate() {
    let folder = Folder::new();
    let mut renderer = splats(&folder);
    let start = Camera { intrinsics: Intrinsics::from_fov(84, 56, 1.0, 0.7), pose: Pose::IDENTITY };
    let stripes =
        (0..84 * 56).flat_map(|i| [if i % 84 / 7 % 2 == 0 { 250 } else { 20 }, 120, (i / 84) as u8]).collect();
    let photo = Image::new(84, 56, stripes).expect("a picture");
    let found = align(&mut renderer, &photo, &start, &|| Ok(())).expect("aligned");
    let (turn, shift) = (found.camera.pose.rotation, found.camera.pose.translation.length());
    let angle = ((turn.x_axis.x + turn.y_axis.y + turn.z_axis.z - 1.0) / 2.0).clamp(-1.0, 1.0).acos();
    assert!(angle < MOST_TURN && shift < MOST_SHIFT, "{angle} radians and {shift}");
    assert!((angle - found.turn).abs() < 1e-6 && (shift - found.shift).abs() < 1e-6, "another movement is told");
    let black = Image::new(84, 56, vec![3; 3 * 84 * 56]).expect("a picture");
    let found = align(&mut renderer, &black, &start, &|| Ok(())).expect("aligned");
    assert_eq!((found.camera, found.doubt), (start, Some(Doubt::Flat)));
}

#[test]
fn a_camera_is_found_by_its_photo() {
    let folder = Folder::new();
    let mut renderer = splats(&folder);
    let truth = Camera { intrinsics: Intrinsics::from_fov(84, 56, 1.0, 0.7), pose: Pose::IDENTITY };
    let frame = renderer.render(&[truth], &RenderOptions::default()).expect("drawn").remove(0);
    let photo = Image::from_rgb_f32(84, 56, &frame.rgb.expect("color")).expect("a picture");
    let rotation = DMat3::from_rotation_y(0.06) * DMat3::from_rotation_x(-0.04) * DMat3::from_rotation_z(0.05);
    let start = Camera { pose: Pose { rotation, translation: DVec3::new(0.06, -0.04, 0.05) }, ..truth };
    let aligned = align(&mut renderer, &photo, &start, &|| Ok(())).expect("aligned");
    let (found, likeness) = (aligned.camera, |drawn: &[f32]| psnr(drawn, &values(&photo)));
    assert!(likeness(&aligned.drawn) > likeness(&aligned.before) + 10.0, "the pictures are those of the cameras");
    let (angle, distance) = (found.pose.rotation.x_axis.angle_between(DVec3::X), found.pose.translation.length());
    assert!(angle < 1e-3 && distance < 2e-3, "{angle} radians and {distance} from the truth");
    assert_eq!(found.intrinsics, truth.intrinsics);
    // Adam's steps do not shrink.
    let found = Method::Adam
        .align(&mut renderer, &[(&photo, &start)], None, &Arena::new(device()), &|_| Ok(()))
        .expect("aligned")
        .remove(0);
    let error = found.camera.pose;
    let (angle, distance) = (error.rotation.x_axis.angle_between(DVec3::X), error.translation.length());
    assert!(angle < 0.01 && distance < 0.01, "{angle} radians and {distance} from the truth, by Adam");
    assert!(likeness(&found.drawn) > likeness(&found.before) + 5.0, "the pictures are those of the cameras");
    let stop = || Err(Error::Cancelled);
    assert!(matches!(align(&mut renderer, &photo, &start, &stop), Err(Error::Cancelled)));
    let again = align(&mut renderer, &photo, &truth, &|| Ok(())).expect("aligned");
    assert!(again.turn < 1e-3 && again.shift < 1e-3 && again.doubt.is_none(), "{} and {}", again.turn, again.shift);
}

#[test]
fn pictures_without_cameras_are_aligned() {
    let folder = place();
    let options = "--weights @/micro.safetensors --input-size 28x28";
    let line = format!("eval @/place --views 2 --targets 2 {options} --json");
    let json = folder.run(&format!("{line} --pose-free --csv @/s.csv -o @/out")).json();
    let psnr = |value: &serde_json::Value| value["psnr"].as_f64().expect("a number");
    let (before, after) = (psnr(&json["aligned"]["unaligned"]), psnr(&json["mean"]));
    assert!(after > before - 0.1, "{before} dB before, {after} after");
    let rows = json["aligned"]["rows"].as_array().expect("rows");
    let near = |row: &serde_json::Value| {
        row["rotation_error_deg"].as_f64().is_some_and(|degrees| (0.0..15.0).contains(&degrees))
    };
    assert!(rows.len() == 2 && rows.iter().all(near), "{}", json["aligned"]);
    let csv = folder.text("s.csv");
    let columns = "view,psnr,ssim,nearest_psnr,mean_color_psnr,lpips,unaligned_psnr,unaligned_ssim,\
        rotation_error_deg,translation_error,warning";
    assert_eq!(csv.lines().next(), Some(columns));
    // Random weights.
    let text = folder.run(&format!("eval @/place --views 2 --targets 2 {options} --pose-free"));
    assert!(text.err.contains("aligned pictures say little"), "{}", text.err);
    assert!(text.out.contains("degrees") && text.out.contains("warning"), "{}", text.out);
    folder.run(&format!("reconstruct {} {options} -o @/scene.ply", inputs(&json))).success();
    assert!(folder.read("out/scene.ply") == folder.read("scene.ply"), "two scenes of the same photos");
    assert!(folder.run(&line).json()["aligned"].is_null());
}

#[test]
fn cameras_are_disturbed_and_refined() {
    let folder = place();
    let line =
        "eval @/place --views 4 --targets 2 --weights @/micro.safetensors --input-size 42x28 --refine 30 --init points";
    let psnr =
        |options: &str| folder.run(&format!("{line} {options} --json")).json()["mean"]["psnr"].as_f64().expect("dB");
    let (exact, wrong, refined) = (psnr(""), psnr("--pose-noise 2"), psnr("--pose-noise 2 --optimize-cameras"));
    assert!(wrong < exact - 0.5 && refined > wrong, "{exact} dB, disturbed {wrong} dB, refined {refined} dB");
    assert!(psnr("--seed 1") != exact && psnr("--seed 0") == exact);
    let text = folder.run(&format!("{line} --pose-noise 2 --optimize-cameras")).success();
    assert!(text.contains("cameras turned by"), "{text}");
}

#[test]
fn colors_are_corrected_where_exposures_were_learned() {
    let folder = place();
    let line = "eval @/place --views 4 --weights @/micro.safetensors --input-size 42x28 --refine 20 --init points";
    let json = folder.run(&format!("{line} --exposure on --csv @/scores.csv --json")).json();
    let [psnr, corrected] = ["psnr", "color_corrected_psnr"].map(|name| json["mean"][name].as_f64().expect("a number"));
    assert!(corrected > psnr, "{psnr} dB, color-corrected {corrected} dB");
    assert_eq!(json["refined"]["exposures"].as_array().map(Vec::len), Some(4));
    let csv = folder.text("scores.csv");
    assert!(csv.starts_with("view,psnr,ssim,nearest_psnr,mean_color_psnr,lpips,color_corrected_psnr\n"), "{csv}");
    let text = folder.run(&format!("{line} --exposure on")).success();
    assert!(text.contains("color-corrected"), "{text}");
    let json = folder.run(&format!("{line} --exposure off --json")).json();
    assert!(json["mean"]["color_corrected_psnr"].is_null() && json["refined"]["exposures"].is_null());
}

#[test]
fn photos_of_the_folder_alone_are_compared() {
    let folder = place();
    folder.make("subset");
    for i in 1..5 {
        let [from, to] = ["place/images", "subset"].map(|place| folder.path(&format!("{place}/{i:03}.png")));
        std::fs::copy(from, to).expect("copied");
    }
    let micro = "--weights @/micro.safetensors --input-size 28x28 --lpips none";
    let json = folder.run(&format!("eval @/subset --cameras @/place/transforms.json --views 2 {micro} --json")).json();
    let compared = json["views"].as_array().expect("rows").iter().map(|row| &row["view"]);
    let mut names: Vec<_> =
        compared.chain(json["inputs"].as_array().expect("names")).filter_map(|name| name.as_str()).collect();
    names.sort_unstable();
    assert_eq!(names, [1, 2, 3, 4].map(|i| format!("images/{i:03}.png")));
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let folder = place();
    folder.run("eval @/place --views 6 --weights @/micro.safetensors").fails(3, &["photos with cameras", "more than"]);
    folder.run("eval @/photos --weights @/micro.safetensors").fails(3, &["poses", "transforms.json"]);
    folder.run("eval @/place --csv @/missing/x.csv").fails(3, &["output folder"]);
    assert_eq!(zipsplat("eval place --scene-scale -1").code, 2);
    folder.write("place/points.ply", "no point cloud");
    folder
        .run("eval @/place --views 2 --weights @/micro.safetensors --input-size 28x28 --csv @/s.csv")
        .fails(3, &["points.ply"]);
    assert!(!folder.path("s.csv").exists());
}
