use crate::Folder;
use zipsplat::types::{
    Image,
    poses::{Capture, read_cloud},
    read_ply, read_points,
};

const WEIGHTS: &str = "--weights @/da3.safetensors";

#[test]
fn a_folder_gets_depth_cameras_and_points() {
    let folder = Folder::new().with_depth();
    let line = format!("depth @/photos {WEIGHTS} --input-size 42 --max-points 500 -o @/out --json");
    let json = folder.run(&line).json();
    assert_eq!((&json["views"], &json["width"], &json["height"]), (&2.into(), &42.into(), &28.into()));
    let expected = [
        "1.colors.png",
        "1.depth.png",
        "10.colors.png",
        "10.depth.png",
        "depths.safetensors",
        "points.ply",
        "transforms.json",
    ];
    assert_eq!(crate::names(&folder.path("out")), expected);
    assert_eq!(Image::size(folder.path("out/1.depth.png")).unwrap(), (42, 28));
    let picture = folder.read("out/1.depth.png");
    let scale = format!("depth_levels_per_unit\0{}", json["depth_levels_per_unit"].as_f64().unwrap() as f32);
    assert!(picture.windows(scale.len()).any(|window| window == scale.as_bytes()), "{scale}");
    let bytes = folder.read("out/depths.safetensors");
    let values = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    for (name, shape) in [
        ("depth", &[2, 28, 42][..]),
        ("confidence", &[2, 28, 42]),
        ("rays", &[2, 16, 24, 6]),
        ("ray_confidence", &[2, 16, 24]),
    ] {
        assert_eq!(values.tensor(name).unwrap().shape(), shape, "{name}");
    }
    let points = read_points(folder.path("out/points.ply")).unwrap().positions.len();
    assert!((100..=500).contains(&points) && json["points"] == points, "{points} points");
    let poses = folder.capture("out/transforms.json");
    let sizes: Vec<_> = poses.frames.iter().map(|frame| frame.camera.intrinsics.width).collect();
    assert_eq!(sizes, [40, 40]);
    assert!(poses.frames.iter().all(|frame| frame.photo.is_some()), "{poses:?}");
    let read =
        || ["points.ply", "depths.safetensors"].map(|name| std::fs::read(folder.path("out").join(name)).unwrap());
    let first = read();
    folder.run(&line).success();
    assert!(read() == first, "other bits");
}

#[test]
fn wrong_arguments_are_named() {
    let folder = Folder::new().with_depth();
    let depth = |rest: &str| folder.run(&format!("depth @/photos -o @/out {rest}"));
    depth("--weights seeded:da3-tiny").fails(3, &["da3-tiny", "da3-small"]);
    depth("--weights @/micro.safetensors").fails(3, &["micro.safetensors", "da3-base"]);
    depth("--weights @/none.safetensors").fails(3, &["none.safetensors"]);
    depth(&format!("{WEIGHTS} --reference 3 --input-size 42")).fails(3, &["--reference-view", "2", "0 to 1"]);
    depth("").fails_usage();
    assert_eq!(folder.names(), ["alone.safetensors", "da3.safetensors", "micro.safetensors", "photos"]);
}

fn focals(poses: &Capture) -> Vec<[f64; 2]> {
    poses.frames.iter().map(|frame| frame.camera.intrinsics).map(|lens| [lens.fx, lens.fy]).collect()
}

#[test]
fn cameras_are_those_of_the_network() {
    let folder = Folder::new().with_depth();
    folder.run(&format!("depth @/photos {WEIGHTS} --input-size 70 --colmap-model @/depth/model -o @/depth")).success();
    let line = format!("cameras @/photos --method da3 {WEIGHTS} --matching-size 70");
    let json = folder.run(&format!("{line} --colmap-model @/model -o @/transforms.json --json")).json();
    assert_eq!((&json["registered"], &json["program"]), (&2.into(), &"da3-micro".into()), "{json}");
    assert!(!folder.path("colmap.log").exists());
    let [of_depth, found] = ["depth/transforms.json", "transforms.json"].map(|name| folder.capture(name));
    let cameras = |poses: &Capture| poses.frames.iter().map(|frame| frame.camera).collect::<Vec<_>>();
    assert_eq!(cameras(&found), cameras(&of_depth));
    let points = |poses: &Capture| read_points(poses.points.as_ref().expect("they lie beside it")).unwrap();
    assert!(points(&found).positions.len() > 500 && points(&found) == points(&of_depth));
    let shared = focals(&found);
    assert!(shared[0][0] == shared[0][1] && shared[0] == shared[1], "{shared:?}");
    folder.run(&format!("{line} --per-view-focal -o @/own.json")).success();
    let own = focals(&folder.capture("own.json"));
    assert!(own[0][0] != own[0][1] && own[0] != own[1], "{own:?}");
    let mean = |[fx, fy]: [f64; 2]| (fx * fy).sqrt();
    assert!(own.iter().any(|focal| (mean(*focal) / shared[0][0] - 1.0).abs() < 1e-9), "{own:?} {shared:?}");

    for (model, points_of) in [("model", "points.ply"), ("depth/model", "depth/points.ply")] {
        let read = folder.capture(model);
        let names: Vec<&str> = read.frames.iter().map(|frame| frame.name.as_str()).collect();
        assert_eq!(names, ["1.png", "10.png"]);
        for (one, other) in read.frames.iter().zip(&found.frames) {
            assert_eq!(one.camera.intrinsics, other.camera.intrinsics);
            assert!(one.camera.pose.translation.distance(other.camera.pose.translation) < 1e-9);
        }
        let files = [read.points.expect("points"), folder.path(points_of)];
        let [own, other] = files.map(|file| read_cloud(file).unwrap());
        assert_eq!(own, other);
    }
}

#[test]
fn other_commands_take_cameras_of_the_network() {
    let folder = Folder::new().with_depth();
    let find = "--cameras da3 --depth-weights @/da3.safetensors --matching-size 64";
    let micro = "--weights @/micro.safetensors --input-size 28x28";
    let line = format!("reconstruct @/photos {find} {micro} --cameras-out @/found.json -o @/scene.ply --json");
    let outcome = folder.run(&line);
    assert!(outcome.err.contains("cameras found: 2 of 2 photos"), "{}", outcome.err);
    assert_eq!((&outcome.json()["photos"], folder.capture("found.json").frames.len()), (&2.into(), 2));
    let line = format!("refine @/photos {find} --init points --steps 1 -o @/refined.ply --json");
    assert_eq!(folder.run(&line).json()["photos"], 2);
}

#[test]
fn a_network_that_finds_no_cameras_is_named() {
    let folder = Folder::new().with_depth();
    let cameras = |rest: &str| folder.run(&format!("cameras @/photos -o @/c.json {rest}"));
    let alone = ["da3-micro-alone, which sees each photo by itself", "no camera decoder", "da3-base"];
    cameras("--method da3 --weights @/alone.safetensors").fails(3, &alone);
    cameras("--method da3").fails_usage();
    cameras("--weights @/da3.safetensors").fails(3, &["--weights", "--method da3"]);
    folder.run("refine @/photos --cameras da3 --init points -o @/s.ply").fails(3, &["--depth-weights", "no weights"]);
    folder.run("refine @/s.ply @/photos --cameras da3 -o @/t.ply").fails(3, &["--cameras da3", "--init points"]);
    let rays = format!("--method da3 {WEIGHTS} --matching-size 64 --camera-source rays");
    cameras(&rays).fails(3, &["rays that agree on a camera", "at least half"]);
    assert_eq!(folder.names(), ["alone.safetensors", "da3.safetensors", "micro.safetensors", "photos"]);
}

fn made(json: &serde_json::Value) -> [u64; 4] {
    ["views", "tokens", "all_tokens", "gaussians"].map(|key| json[key].as_u64().unwrap_or_default())
}

#[test]
fn photos_become_a_gaussian_a_pixel() {
    let folder = Folder::new().with_depth();
    let plain = format!("reconstruct @/photos {WEIGHTS} --input-size 70x70 -o @/scene.ply");
    let line = format!("{plain} --json");
    let outcome = folder.run(&format!("{line} --cameras-out @/cameras.json"));
    assert!(outcome.err.contains("cameras found: 2 of 2 photos"), "{}", outcome.err);
    let json = outcome.json();
    let [views, tokens, all, gaussians] = made(&json);
    assert_eq!((views, tokens, all, &json["network"]), (2, 40, 40, &"da3-micro".into()));
    assert!((1000..=7840).contains(&gaussians), "{json}");
    let scene = read_ply(folder.path("scene.ply")).unwrap();
    assert_eq!(scene.len() as u64, gaussians);
    assert!(scene.opacities.iter().all(|opacity| (0.05..=0.951).contains(opacity)));

    let [_, tokens, all, of_half] = made(&folder.run(&format!("{line} --ratio 0.5")).json());
    assert_eq!(all, 40);
    assert!((10..=20).contains(&tokens) && of_half < gaussians && of_half <= 196 * tokens, "{tokens}: {of_half}");
    let [_, tokens, _, few] = made(&folder.run(&format!("{line} --max-gaussians-per-token 3")).json());
    assert!(tokens == 40 && few > 60 && few <= 120, "{few}");

    let cameras = folder.capture("cameras.json");
    assert_eq!(cameras.frames.len(), 2);
    let given = folder.run(&format!("{plain} --cameras @/cameras.json --cameras-out @/again.json"));
    given.fails(3, &["--cameras-out", "cameras that are known"]);
    assert_eq!(made(&folder.run(&format!("{line} --cameras @/cameras.json")).json())[..3], [2, 40, 40]);
    let refine = "--max-gaussians-per-token 2 --cameras da3 --refine=2 --holdout-views 0";
    let refined = folder.run(&format!("{line} {refine} --optimize-cameras --cameras-out @/new/garden.json")).json();
    assert_eq!((&refined["refined"]["init"], &refined["refined"]["steps"]), (&"the scene".into(), &2.into()));
    let optimized = folder.capture("new/garden.json");
    assert!(optimized.frames[1].camera != cameras.frames[1].camera);
    assert!(optimized.points.is_some_and(|points| points.ends_with("new/garden.points.ply")));
}

#[test]
fn photos_seen_by_themselves_need_cameras_and_points() {
    let folder = Folder::new().with_depth();
    folder.run("scene --seed 3 --views 2 --size 42x28 -o @/place").success();
    let line = "reconstruct @/place/images --weights @/alone.safetensors --input-size 42x42 -o @/scene.ply";
    folder.run(line).fails(3, &["da3-micro-alone, which sees each photo by itself", "known cameras"]);
    let json = folder.run(&format!("{line} --cameras @/place/transforms.json --json")).json();
    assert!(made(&json)[3] > 100, "{json}");
    let (points, scene) =
        (read_points(folder.path("place/points.ply")).unwrap(), read_ply(folder.path("scene.ply")).unwrap());
    let first = folder.capture("place").frames[0].camera;
    let middle = |mut depths: Vec<f64>| {
        depths.sort_by(f64::total_cmp);
        depths[depths.len() / 2]
    };
    let of_points = points.positions.iter().map(|at| first.pose.inverse().transform(at.map(f64::from).into()).z);
    let [of_points, of_scene] = [
        middle(of_points.filter(|z| *z > 0.0).collect()),
        middle(scene.means.iter().map(|mean| f64::from(mean[2])).collect()),
    ];
    assert!((0.3..3.0).contains(&(of_scene / of_points)), "{of_scene} {of_points}");
    // Metric depth needs the focal length of the network's input.
    let depth = |rest: &str| {
        let line = format!("depth @/place/images --weights @/alone.safetensors --input-size 42 -o @/out {rest}");
        folder.run(&line).success();
        let bytes = folder.read("out/depths.safetensors");
        let values = safetensors::SafeTensors::deserialize(&bytes).unwrap().tensor("depth").unwrap().data().to_vec();
        f32::from_le_bytes(*values.first_chunk().unwrap())
    };
    let (plain, meters) = (depth(""), depth("--cameras @/place/transforms.json --metric"));
    let focal = first.intrinsics.fx;
    assert!((f64::from(meters / plain) - focal / 300.0).abs() < 1e-5, "{meters} {plain} {focal}");
    let of_all =
        format!("depth @/place/images {WEIGHTS} --input-size 42 -o @/all --cameras @/place/transforms.json --metric");
    folder.run(&of_all).fails(3, &["--metric", "da3-micro"]);
    folder.remove("place/points.ply");
    folder.run(&format!("{line} --cameras @/place/transforms.json")).fails(3, &["scale of the depth", "points"]);
}

#[test]
fn weights_are_known_by_their_tensors() {
    let folder = Folder::new().with_depth();
    let info = folder.run("convert @/da3.safetensors --json").json();
    assert_eq!(
        (&info["kind"], &info["estimates_cameras"], &info["sky"]),
        (&"Depth Anything 3".into(), &true.into(), &false.into())
    );
    assert_eq!(folder.run("convert @/alone.safetensors --json").json()["estimates_cameras"], false);
    let text = folder.run("convert seeded:da3-giant").success();
    assert!(text.contains("da3-giant of Depth Anything 3") && text.contains("a Gaussian a pixel"), "{text}");
    let plan = folder
        .run("reconstruct --dry-run --weights seeded:da3-small --views 2 --input-size 252x168 --ratio 0.5 --json")
        .json();
    assert_eq!((&plan["tokens"], &plan["network"]), (&216.into(), &"da3-small".into()), "{plan}");
    assert!(plan["peak_bytes"].as_u64() > plan["weight_bytes"].as_u64());

    // Exact in 16 bits, rounded to 8.
    let values = |file: &str| {
        folder.run(&format!("depth @/photos --weights @/{file} --input-size 42 -o @/{file}.out")).success();
        let bytes = folder.read(&format!("{file}.out/depths.safetensors"));
        let found = safetensors::SafeTensors::deserialize(&bytes).unwrap().tensor("depth").unwrap().data().to_vec();
        found.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect::<Vec<f32>>()
    };
    let exact = values("da3.safetensors");
    for (dtype, within) in [("f16", 1e-9), ("q8", 0.2)] {
        folder.run(&format!("convert @/da3.safetensors @/{dtype}.safetensors --dtype {dtype}")).success();
        let json = folder.run(&format!("convert @/{dtype}.safetensors --json")).json();
        assert!(json["stored"][dtype].as_u64() > Some(0) && json["architecture"] == info["architecture"], "{json}");
        let rounded = values(&format!("{dtype}.safetensors"));
        let apart: f32 = exact.iter().zip(&rounded).map(|(a, b)| (a / b).ln().abs()).sum::<f32>() / exact.len() as f32;
        assert!(apart < within, "{dtype}: {apart}");
    }
    let tradeoff = "bench tradeoff @/photos --weights @/da3.safetensors -o @/report";
    folder.run(tradeoff).fails(3, &["of Depth Anything 3", "of ZipSplat"]);
    let refused = |rest: &str| folder.run(&format!("reconstruct @/photos {WEIGHTS} -o @/s.ply {rest}"));
    refused("--crop tiles").fails(3, &["--crop tiles", "weights of ZipSplat"]);
    refused("--max-gaussians-per-token 197").fails(3, &["--max-gaussians-per-patch", "1 to 196"]);
    refused("--cameras da3 --refine=2 --refine-target tokens").fails(3, &["tokens", "weights of ZipSplat"]);
}

#[test]
fn scenes_of_pixels_are_judged() {
    let folder = Folder::new().with_depth();
    folder.run("scene --seed 3 --views 5 --size 42x28 -o @/place").success();
    let eval = |rest: &str| folder.run(&format!("eval @/place --views 3 {WEIGHTS} --input-size 42x28 {rest}"));
    let json = eval("-o @/judged --json").json();
    let [tokens, all] = ["tokens", "all_tokens"].map(|key| json[key].as_u64());
    assert_eq!((tokens, all, json["views"].as_array().map(Vec::len)), (Some(18), Some(18), Some(2)), "{json}");
    assert!(json["mean"]["psnr"].as_f64().is_some_and(f64::is_finite), "{json}");
    let inputs = json["inputs"].as_array().unwrap().iter().map(|name| format!("@/place/{}", name.as_str().unwrap()));
    let inputs: Vec<String> = inputs.collect();
    let line =
        format!("reconstruct {} --cameras @/place {WEIGHTS} --input-size 42x28 -o @/scene.ply", inputs.join(" "));
    folder.run(&line).success();
    let [judged, made] = ["judged/scene.ply", "scene.ply"].map(|file| read_ply(folder.path(file)).unwrap());
    assert_eq!((judged.len() as u64, judged.len()), (json["gaussians"].as_u64().unwrap(), made.len()));
    let apart = judged.means.iter().zip(&made.means).flat_map(|(a, b)| [0, 1, 2].map(|k| (a[k] - b[k]).abs()));
    let size = made.means.iter().flatten().fold(0.0, |most: f32, x| most.max(x.abs()));
    assert!(apart.fold(0.0, f32::max) < 1e-5 * size, "another scene");

    let half = eval("--ratio 0.5 --json").json();
    assert!(half["tokens"].as_u64() < Some(10) && half["gaussians"].as_u64() < json["gaussians"].as_u64(), "{half}");
    let refined = eval("--refine 2 --init scene --json").json();
    assert_eq!(refined["refined"]["init"], "the scene");
    eval("--refine=2 --refine-target tokens").fails(3, &["--refine-target tokens", "weights of ZipSplat"]);
    eval("--crop tiles").fails(3, &["--crop tiles", "weights of ZipSplat"]);
    eval("--max-gaussians-per-token 200").fails(3, &["--max-gaussians-per-patch", "1 to 196"]);
    let alone = "eval @/place --views 3 --weights @/alone.safetensors --input-size 42x28";
    assert!(folder.run(&format!("{alone} --json")).json()["mean"]["psnr"].as_f64().is_some());
    folder.run(&format!("{alone} --pose-free")).fails(3, &["da3-micro-alone", "no camera decoder"]);
}

#[test]
fn scenes_of_pixels_are_shown() {
    let folder = Folder::new().with_depth();
    let line = format!("view @/photos {WEIGHTS} --input-size 42x42 -o @/page.html");
    let json = folder.run(&format!("{line} --ratios 0.5,1 --json")).json();
    let counts: Vec<u64> = json["gaussians"].as_array().unwrap().iter().filter_map(|count| count.as_u64()).collect();
    assert!(counts.len() == 2 && counts[0] > counts[1] && counts[1] > 0, "{json}");
    let scene = folder.run(&format!("reconstruct @/photos {WEIGHTS} --input-size 42x42 -o @/scene.ply --json")).json();
    assert_eq!(scene["gaussians"].as_u64(), Some(counts[0]));
    let page = folder.text("page.html");
    assert!(page.contains("ratio 0.5") && page.contains("\"cameras\":[{"), "no camera, or no slider");
    let first_camera = |options: &str| {
        folder.run(&format!("{line} --ratios 1 {options}")).success();
        let page = folder.text("page.html");
        let (_, cameras) = page.split_once("\"cameras\":[{").expect("cameras");
        cameras.split('}').next().map(str::to_owned)
    };
    assert_ne!(first_camera(""), first_camera("--per-view-focal"));
    folder.run(&format!("{line} --refine=2 --cameras da3")).fails(3, &["--refine", "weights of ZipSplat"]);
    folder.run(&format!("{line} --ratio 0.5")).fails(3, &["--ratio", "--ratios R,R"]);
    let alone = line.replace("da3.safetensors", "alone.safetensors");
    folder.run(&alone).fails(3, &["da3-micro-alone", "no camera decoder"]);
}

#[test]
fn errors_are_told_where_there_is_a_truth() {
    let folder = Folder::new().with_depth();
    folder.run("scene --seed 3 --views 3 --size 42x28 -o @/place").success();
    let line = format!("depth @/place/images {WEIGHTS} --input-size 42 -o @/out --ground-truth @/place --json");
    let errors = &folder.run(&line).json()["errors"];
    let number = |errors: &serde_json::Value, key: &str| errors[key].as_f64();
    assert_eq!(errors["photos"], 3);
    assert!(number(errors, "rotation_error_deg").is_none_or(|degrees| degrees > 1.0), "{errors}");
    assert!(number(errors, "abs_rel") > Some(0.05) && number(errors, "delta_1_25") < Some(0.99), "{errors}");
    let errors = &folder.run(&format!("{line} --cameras @/place/transforms.json")).json()["errors"];
    assert!(errors["rotation_error_deg"].is_null() && number(errors, "abs_rel").is_some(), "{errors}");
    std::fs::remove_dir_all(folder.path("place/depth")).unwrap();
    let report = folder.run(&line).json();
    assert!(report["errors"]["abs_rel"].is_null(), "{report}");
    let strangers = format!("depth @/photos {WEIGHTS} --input-size 42 -o @/other --ground-truth @/place");
    folder.run(&strangers).fails(3, &["photos with a truth", "place"]);
}
