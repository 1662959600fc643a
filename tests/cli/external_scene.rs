use crate::Folder;
use glam::{DMat3, DVec3};
use zipsplat::types::{Camera, Pose, Scene, poses::write_transforms, read_ply, read_points, write_ply, write_points};

/// Of the cameras, relative to the first camera's scene.
const LENGTH: f64 = 3.0;

fn world() -> Pose {
    let rotation = DMat3::from_rotation_z(0.7) * DMat3::from_rotation_x(-1.1);
    Pose { rotation, translation: DVec3::new(4.0, -2.0, 7.0) }
}

/// Without sky, in `@/place`, with cameras in their own world and a scene in the first camera's, at
/// a third of the scale.
fn place(folder: &Folder) -> (Scene, Vec<Camera>) {
    folder.run("scene --seed 9 --views 8 --size 56x56 --splats -o @/place").success();
    let frames = folder.capture("place").frames;
    let scene = read_ply(folder.path("place/splats.ply")).expect("a scene");
    let moved = |camera: Camera| {
        let pose = Pose { translation: LENGTH * camera.pose.translation, ..camera.pose };
        Camera { pose: world().compose(&pose), ..camera }
    };
    let cameras: Vec<Camera> = frames.iter().map(|frame| moved(frame.camera)).collect();
    let names: Vec<&str> = frames.iter().map(|frame| frame.name.as_str()).collect();
    write_transforms(folder.path("place/transforms.json"), &cameras, &names).expect("written");
    let points = read_points(folder.path("place/points.ply")).expect("points");
    let place = |at: [f32; 3]| world().transform(LENGTH * DVec3::from(at.map(f64::from))).as_vec3().to_array();
    let points: Vec<_> = points.positions.into_iter().map(place).zip(points.colors).collect();
    write_points(folder.path("place/points.ply"), &points).expect("written");
    (scene, cameras)
}

fn save(folder: &Folder, name: &str, scene: &Scene, scale: f64, pose: &Pose) {
    let mut scene = scene.clone();
    scene.place(scale, pose);
    write_ply(&scene, folder.path(name)).expect("written");
}

const LINE: &str = "eval @/place --views 3 --input-size 56x56 --lpips none --scene";

fn evaluate(folder: &Folder, options: &str) -> f64 {
    folder.run(&format!("{LINE} {options} --json")).json()["mean"]["psnr"].as_f64().expect("dB")
}

#[test]
fn a_scene_is_judged_alike_in_every_layout() {
    let folder = Folder::new();
    let (scene, cameras) = place(&folder);
    // Worlds: the cameras' (3DGS, brush), the first camera's (pose-free systems), its axes alone
    // (DepthSplat).
    save(&folder, "cameras.ply", &scene, LENGTH, &world());
    save(&folder, "first.ply", &scene, 1.0, &Pose::IDENTITY);
    let axes = cameras[0].pose.rotation.transpose();
    let turned = Pose { rotation: axes * world().rotation, translation: axes * world().translation };
    save(&folder, "turned.ply", &scene, LENGTH, &turned);
    // Any similarity, as of MVSplat for viewers.
    let away = Pose { rotation: DMat3::from_rotation_y(2.0), translation: DVec3::new(-1.0, 0.5, 0.25) };
    save(&folder, "away.ply", &scene, 0.2, &away);
    let frames = folder.capture("place").frames;
    let external = |camera: &Camera| {
        let pose = world().inverse().compose(&camera.pose);
        let pose = Pose { translation: 0.2 / LENGTH * pose.translation, ..pose };
        Camera { pose: away.compose(&pose), ..*camera }
    };
    let moved: Vec<Camera> = cameras.iter().map(external).collect();
    let names: Vec<&str> = frames.iter().map(|frame| frame.name.trim_start_matches("images/")).collect();
    write_transforms(folder.path("theirs.json"), &moved, &names).expect("written");
    // As in NoPoSplat, C3G, AnySplat and MVSplat.
    let mut plain = scene.clone();
    plain.opacities.iter_mut().for_each(|opacity| *opacity = 1.0 / (1.0 + (-*opacity).exp()));
    save(&folder, "plain.ply", &plain, 1.0, &Pose::IDENTITY);

    let expected = evaluate(&folder, "@/cameras.ply --scene-frame input-cameras");
    for options in [
        "@/first.ply --scene-unit 3".to_owned(),
        "@/first.ply --scene-frame first-camera --scene-unit 3".to_owned(),
        "@/turned.ply --scene-frame turned".to_owned(),
        folder.line("@/away.ply --scene-cameras @/theirs.json"),
        folder.line("@/away.ply --scene-frame aligned --scene-cameras @/theirs.json"),
        "@/plain.ply --opacities plain --scene-unit 3".to_owned(),
    ] {
        let found = evaluate(&folder, &options);
        assert!((found - expected).abs() < 0.02, "{options}: {found} dB, {expected} dB");
    }
    for options in ["@/cameras.ply", "@/first.ply", "@/turned.ply --scene-frame input-cameras", "@/away.ply"] {
        let found = evaluate(&folder, options);
        assert!(found < expected - 3.0, "{options}: {found} dB, {expected} dB");
    }
    folder.run("convert @/first.ply @/first.spz").success();
    let packed = evaluate(&folder, "@/first.spz --scene-unit 3");
    assert!((packed - expected).abs() < 0.5, "{packed} dB, {expected} dB");
    folder
        .run("eval @/place --views 3 --weights @/micro.safetensors --input-size 56x56 --lpips none -o @/ours")
        .success();
    let ours = "eval @/place --views 3 --weights @/micro.safetensors --input-size 56x56 --lpips none --json";
    let made = folder.run(ours).json()["mean"]["psnr"].as_f64().expect("dB");
    let read = folder.run(&format!("{ours} --scene @/ours/scene.ply")).json()["mean"]["psnr"].as_f64().expect("dB");
    assert!((made - read).abs() < 1e-3, "{made} dB, from the file {read} dB");
}

#[test]
fn opacities_that_may_be_plain_are_noted() {
    let folder = Folder::new();
    let (mut scene, _) = place(&folder);
    write_ply(&scene, folder.path("logits.ply")).expect("written");
    let outcome = folder.run(&format!("{LINE} @/logits.ply"));
    assert!(outcome.code == 0 && !outcome.err.contains("--opacities plain"), "{}", outcome.err);
    folder.run(&format!("{LINE} @/logits.ply --opacities plain")).fails(3, &["logits.ply", "Gaussian 0", "0 to 1"]);
    scene.opacities.iter_mut().for_each(|opacity| *opacity = 0.7);
    write_ply(&scene, folder.path("plain.ply")).expect("written");
    let outcome = folder.run(&format!("{LINE} @/plain.ply"));
    assert!(outcome.code == 0 && outcome.err.contains("--opacities plain"), "{}", outcome.err);
}

#[test]
fn pictures_of_a_scene_are_aligned_where_asked() {
    let folder = Folder::new();
    let (scene, _) = place(&folder);
    let off = Pose { rotation: DMat3::from_rotation_y(0.03), translation: DVec3::new(0.02, 0.0, 0.01) };
    save(&folder, "off.ply", &scene, 1.0, &off);
    let line = format!("{LINE} @/off.ply --scene-unit 3 --targets 1");
    let [given, aligned] = ["", "--align levenberg-marquardt"]
        .map(|options| folder.run(&format!("{line} {options} --json")).json()["mean"]["psnr"].as_f64().expect("dB"));
    assert!(aligned > given + 1.0, "{given} dB, aligned {aligned} dB");
}

fn depth(folder: &Folder, number: usize) -> Vec<f32> {
    let bytes = folder.read(&format!("place/depth/{number:03}.npy"));
    bytes[128..].as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

#[test]
fn a_gaussian_a_pixel_is_made_of_depth() {
    let folder = Folder::new().with_depth();
    folder.run("scene --seed 9 --views 8 --size 84x56 --splats -o @/place").success();
    let line = "eval @/place --views 4 --lpips none --from-depth @/place/depth";
    let json = folder.run(&format!("{line} --input-size 84x56 -o @/out --json")).json();
    let names: Vec<&str> = json["inputs"].as_array().expect("names").iter().filter_map(|name| name.as_str()).collect();
    let splats = read_ply(folder.path("place/splats.ply")).expect("a scene");
    let made = read_ply(folder.path("out/scene.ply")).expect("a scene");
    let (mut start, mut at) = (0, 0);
    for number in 0..8 {
        let count = depth(&folder, number).iter().filter(|z| **z > 0.0).count();
        if names.contains(&format!("images/{number:03}.png").as_str()) {
            for i in 0..count {
                let [a, b] = [made.means[at + i], splats.means[start + i]].map(glam::Vec3::from);
                assert!(a.distance(b) < 1e-4 * b.length().max(1.0), "{number}: {a} and {b}");
                assert!(made.scales[at + i][0] / splats.scales[start + i][0] < 1.001);
                assert_eq!(made.sh_coeffs[at + i], splats.sh_coeffs[start + i]);
            }
            at += count;
        }
        start += count;
    }
    assert_eq!((at, json["gaussians"].as_u64()), (made.len(), Some(made.len() as u64)));
    let psnr = |json: &serde_json::Value| json["mean"]["psnr"].as_f64().expect("dB");
    let [whole, small] = ["84x56", "28x28"].map(|size| {
        let json = folder.run(&format!("{line} --input-size {size} --eval-size 28x28 --json")).json();
        (json["gaussians"].as_u64().expect("a number"), psnr(&json))
    });
    assert!(small.0 <= 4 * 28 * 28 && whole.0 > 5 * small.0 && small.1 > whole.1 - 4.0, "{whole:?} {small:?}");
    let found = folder.run(&format!("{line} --input-size 84x56 --scene-scale @/place/depth --json")).json();
    let mut distances: Vec<f64> = made.means.iter().map(|mean| f64::from(glam::Vec3::from(*mean).length())).collect();
    distances.sort_by(f64::total_cmp);
    let median = distances[distances.len() / 2];
    let scale = found["scene_scale"].as_f64().expect("a number");
    assert!((scale / median - 1.0).abs() < 1e-4 && found["scene_scale_source"] == "depth", "{scale}, {median}");
    assert!((psnr(&found) - psnr(&json)).abs() < 0.05, "the cameras have the unit, too");
    let of_network = line.replace("--from-depth @/place/depth", "--weights @/micro.safetensors");
    let of_network = format!("{of_network} --input-size 28x28 --scene-scale @/da3.safetensors --json");
    let found = folder.run(&of_network).json();
    assert!(found["scene_scale"].as_f64().is_some_and(|scale| scale > 0.0) && found["scene_scale_source"] == "depth");
    let half = folder.run(&format!("{of_network} --ratio 0.5")).json();
    assert_eq!(half["scene_scale"], found["scene_scale"], "all pixels have the scale");
    let json = folder.run(&format!("{line} --input-size 28x28 --targets 1 --refine 2 --json")).json();
    assert_eq!((&json["refined"]["init"], &json["refined"]["steps"]), (&"the scene".into(), &2.into()));
    let refuses = |words: &[&str]| folder.run(&format!("{line} --input-size 28x28")).fails(3, words);
    let file = folder.path("place/depth/000.npy");
    let bytes = std::fs::read(&file).expect("depth");
    std::fs::write(&file, String::from_utf8_lossy(&bytes[..100]).into_owned()).expect("written");
    refuses(&["000.npy", ".npy"]);
    let text = String::from_utf8_lossy(&bytes[10..128]).replace("(56, 84)", "(84, 56)");
    std::fs::write(&file, [&bytes[..10], text.as_bytes(), &bytes[128..]].concat()).expect("written");
    refuses(&["000.npy", "56x84", "84x56"]);
    std::fs::remove_file(&file).expect("removed");
    refuses(&["none for", "000.png", "NAME.npy"]);
    folder.run(&format!("{line} --scene @/out/scene.ply")).fails_usage();
}

#[test]
fn scenes_that_cannot_be_placed_are_refused() {
    let folder = Folder::new();
    let (scene, cameras) = place(&folder);
    write_ply(&scene, folder.path("scene.ply")).expect("written");
    write_transforms(folder.path("one.json"), &cameras[..1], &["000.png"]).expect("written");
    let refuses = |options: &str, words: &[&str]| folder.run(&format!("{LINE} {options}")).fails(3, words);
    refuses("@/scene.ply --scene-frame aligned", &["--scene-cameras", "nothing"]);
    refuses("@/scene.ply --scene-cameras @/one.json", &["--scene-cameras", "1 of the 3 input photos"]);
    refuses(
        "@/scene.ply --scene-frame first-camera --scene-cameras @/one.json",
        &["--scene-frame", "--scene-frame aligned"],
    );
    refuses("@/missing.ply", &["missing.ply"]);
    folder.run("eval @/place --scene-frame first-camera").fails_usage();
    folder.run("eval @/place --drop-invalid").fails(3, &["--drop-invalid", "--scene"]);
    folder.run(&format!("{LINE} @/scene.ply --refine 5")).fails_usage();
}
