use crate::{Folder, names, zipsplat};
use glam::{DMat3, DVec3};
use zipsplat::types::{Camera, Intrinsics, Pose, Scene, poses::write_transforms, read_ply};
use zipsplat::weights::Checkpoint;
use zipsplat_tests::{photos::with_orientation, scenes::scene_extensions};

fn with_cameras() -> Folder {
    let folder = Folder::new();
    let cameras = [zipsplat_tests::scenes::camera(40, 30); 2];
    write_transforms(folder.path("c.json"), &cameras, &["1.png", "10.png"]).expect("cameras can be written");
    folder
}

#[test]
fn two_photos_become_a_scene() {
    let folder = Folder::new();
    let text = folder.run("reconstruct @/photos --weights seeded:vits --input-size 28x28 -o @/scene.ply").success();
    let scene = read_ply(folder.path("scene.ply")).expect("the scene can be read");
    assert_eq!((scene.len(), scene.sh_degree), (2 * 4 * 32, 1));
    for word in ["256 Gaussians", "2 views", "8 of 8 tokens", "load photos", "backbone", "gaussians", "write", "/s)"] {
        assert!(text.contains(word), "'{word}' is not in: {text}");
    }
}

#[test]
fn the_extension_decides_the_format() {
    let folder = Folder::new();
    for extension in scene_extensions() {
        let file = format!("s.{extension}");
        folder
            .run(&format!("reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/{file}"))
            .success();
        let scene = Scene::open(folder.path(&file)).expect("the scene can be read");
        assert_eq!(scene.len(), 2 * 4 * 4, "{file}");
    }
}

#[test]
fn the_ratio_and_selection_decide_the_number() {
    let folder = Folder::new();
    folder.write("tokens.txt", b"3 1\n11\n7\n");
    for (options, tokens) in [
        ("--ratio 0.5", 6),
        ("--ratio auto --kv-pool local/2+own+first", 6),
        ("--ratio 0.3 --token-selection stride", 3),
        ("--ratio 0.3 --token-selection random:7", 3),
        ("--ratio 0.3 --token-selection mutual", 3),
        ("--token-selection @/tokens.txt", 4),
        ("--ratio 1 --precision fp32", 12),
    ] {
        let json = folder
            .run(&format!(
                "reconstruct @/photos --weights @/micro.safetensors --input-size 42x28 {options} --json -o @/s.ply"
            ))
            .json();
        let scene = read_ply(folder.path("s.ply")).expect("the scene can be read");
        assert_eq!((json["tokens"].as_u64(), json["all_tokens"].as_u64()), (Some(tokens), Some(12)), "{options}");
        assert_eq!(scene.len() as u64, 4 * tokens, "{options}");
        for stage in ["load photos", "load weights", "backbone", "fuse", "gaussians", "write"] {
            assert!(json["stage_seconds"][stage].as_f64().is_some_and(|s| s >= 0.0), "{stage}: {json}");
        }
        let stages = json["stage_seconds"].as_object().expect("stages").values();
        let parts = stages.filter_map(serde_json::Value::as_f64).sum::<f64>();
        assert!((parts - json["seconds"].as_f64().expect("a time")).abs() < 1e-6, "{json}");
    }
}

#[test]
fn folders_are_in_natural_order_and_files_as_given() {
    let folder = Folder::new();
    let reconstruct = |photos: &str, output: &str| {
        let line = format!("reconstruct {photos} --weights @/micro.safetensors --input-size 28x28 -q -o @/{output}");
        assert_eq!(folder.run(&line).success(), "");
        folder.read(output)
    };
    let natural = reconstruct("@/photos", "a.ply");
    assert_eq!(natural, reconstruct("@/photos/1.png @/photos/10.png", "b.ply"));
    assert_ne!(natural, reconstruct("@/photos/10.png @/photos/1.png", "c.ply"));
}

#[test]
fn what_is_no_photo_is_left_out_and_named() {
    let folder = Folder::new();
    let line = "reconstruct @/photos --weights @/micro.safetensors --input-size 56x42 --json -o @/s.ply";
    for hidden in ["._1.png", ".DS_Store"] {
        std::fs::write(folder.path("photos").join(hidden), "no photo").expect("a file");
    }
    let clean = folder.run(line);
    assert!(!clean.err.contains("left out"), "{}", clean.err);
    assert_eq!(clean.json()["views"], 2);
    for other in ["IMG_1.HEIC", "clip.mp4"] {
        std::fs::write(folder.path("photos").join(other), "no photo").expect("a file");
    }
    let noted = folder.run(line);
    let note = "note: 2 files left out, not PNG, JPEG, WebP or HEIC: IMG_1.HEIC, clip.mp4\n";
    assert!(noted.err.contains(note), "{}", noted.err);
    assert_eq!(noted.json()["views"], 2);
}

#[test]
fn photos_in_folders_below_are_hinted_at() {
    let folder = Folder::new();
    let line = "--weights @/micro.safetensors --input-size 56x42 -o @/s.ply";
    let below = folder.line("@/photos/");
    folder
        .run(&format!("reconstruct @/ {line}"))
        .fails(3, &["photos in", "found none", "the folder that has them", &below]);
    folder.make("photos/left");
    let quiet = folder.run(&format!("reconstruct @/photos {line}"));
    assert!(!quiet.err.contains("more photos"), "a folder without photos is none to hint at: {}", quiet.err);
    std::fs::copy(folder.path("photos/1.png"), folder.path("photos/left/1.png")).expect("copied");
    let noted = folder.run(&format!("reconstruct @/photos {line}"));
    let hint = folder.line("note: more photos lie in @/photos/left/: name it, too, to take them\n");
    assert!(noted.err.contains(&hint), "{}", noted.err);
    assert!(noted.success().contains("from 2 views"));
}

#[test]
fn cameras_to_learn_from_are_cameras() {
    let folder = Folder::new();
    folder.make("place");
    let cameras = [zipsplat_tests::scenes::camera(40, 30); 2];
    let names = ["train/1.png", "train/10.png"];
    write_transforms(folder.path("place/transforms_train.json"), &cameras, &names).expect("cameras");
    let run = || {
        folder.run("reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 --cameras @/place -o @/s.ply")
    };
    run().success();
    write_transforms(folder.path("place/transforms.json"), &cameras[..1], &names[..1]).expect("cameras");
    let outcome = run();
    assert!(outcome.err.contains("not among the cameras: 10.png"), "{}", outcome.err);
    outcome.success();
}

#[test]
fn some_of_many_photos_are_spread() {
    let folder = Folder::new();
    (2..10).for_each(|i| crate::photo(40, 30, i).save_png(folder.path(&format!("photos/{i}.png"))).expect("a photo"));
    let scene = |photos: &str| {
        let line = format!("reconstruct {photos} --weights @/micro.safetensors --input-size 42x28 -o @/s.ply");
        let text = folder.run(&line).success();
        (text, folder.read("s.ply"))
    };
    let (text, three) = scene("@/photos --views 3");
    assert!(text.contains("from 3 views of"), "{text}");
    // Steps of 4.5 from 1 to 10, halves rounded up.
    assert!(three == scene("@/photos/1.png @/photos/6.png @/photos/10.png").1, "another choice");
    let (text, one) = scene("@/photos --views 1");
    assert!(text.contains("from 1 view of") && one == scene("@/photos/1.png").1, "{text}");
    assert!(scene("@/photos --views 192").0.contains("from 10 views of"));
}

#[test]
fn cropping_much_is_said() {
    let folder = with_cameras();
    let run = |options: &str| {
        let outcome = folder.run(&format!("reconstruct @/photos --weights seeded:vits {options} -o @/s.ply"));
        let notes = outcome.err.lines().filter(|line| line.contains("cropped")).collect::<String>();
        outcome.success();
        notes
    };
    assert_eq!(run("--input-size 28x28"), "note: 25 % of the photos' area is cropped away");
    let posed = run("--input-size 28x28 --cameras @/c.json");
    assert!(posed.contains("25 %") && posed.contains("--crop tiles"), "{posed}");
    assert_eq!(run("--input-size 56x42"), "");
}

#[test]
fn another_size_than_the_trained_one_is_said() {
    let folder = Folder::new();
    let run = |size: &str| folder.run(&format!("reconstruct @/photos/1.png {size} -o @/s.ply")).err;
    let side = Checkpoint::builtin().expect("it is built in").image_size();
    let note = run("--input-size 28x28");
    assert!(note.contains(&format!("trained with pictures of {side}x{side}")) && note.contains("28x28"), "{note}");
    for size in ["", &format!("--input-size {side}x{side}")] {
        assert!(!run(size).contains("trained"), "{size}");
    }
}

#[test]
fn squares_show_whole_photos() {
    let folder = with_cameras();
    let line = "reconstruct @/photos --weights @/micro.safetensors --crop tiles -o @/s.ply";
    let outcome = folder.run(&format!("{line} --input-size 28x28 --cameras @/c.json --json"));
    assert!(outcome.err.contains("2 photos as 4 squares of 28x28"), "{}", outcome.err);
    let json = outcome.json();
    assert_eq!(
        [&json["photos"], &json["views"], &json["all_tokens"]].map(|n| n.as_u64()),
        [Some(2), Some(4), Some(16)]
    );
    folder.run(&format!("{line} --input-size 28x28")).fails(3, &["--crop tiles", "known cameras"]);
    folder.run(&format!("{line} --input-size 28x42 --cameras @/c.json")).fails(3, &["--crop tiles", "as wide as high"]);
}

#[test]
fn poses_count_relative_to_the_first_view() {
    let folder = Folder::new();
    let intrinsics = Intrinsics { width: 40, height: 30, fx: 35.0, fy: 35.0, cx: 20.0, cy: 15.0 };
    let camera = |turn: f64, x: f64| {
        let pose = Pose { rotation: DMat3::from_rotation_y(turn), translation: DVec3::new(x, 0.25, 0.5) };
        Camera { intrinsics, pose }
    };
    let cameras = [camera(0.25, 0.0), camera(0.5, 1.0)];
    let names = ["photos/1.png", "photos/10.png"];
    let world = Pose { rotation: DMat3::from_rotation_x(1.0), translation: DVec3::new(3.0, -2.0, 1.0) };
    let moved = cameras.map(|camera| Camera { pose: world.compose(&camera.pose), ..camera });
    write_transforms(folder.path("here.json"), &cameras, &names).expect("cameras can be written");
    write_transforms(folder.path("moved.json"), &moved, &names).expect("cameras can be written");
    let scene = |options: &str| {
        let line =
            format!("reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 {options} -o @/s.ply");
        folder.run(&line).success();
        read_ply(folder.path("s.ply")).expect("the scene can be read").means
    };
    let (here, moved, none) = (scene("--cameras @/here.json"), scene("--cameras @/moved.json"), scene(""));
    let apart = |other: &[[f32; 3]]| {
        here.as_flattened().iter().zip(other.as_flattened()).fold(0f32, |most, (a, b)| most.max((a - b).abs()))
    };
    assert!(apart(&moved) < 1e-4, "the capture's own world shows: {}", apart(&moved));
    assert!(apart(&none) > 1e-3, "the cameras do not show: {}", apart(&none));
}

#[test]
fn photos_with_cameras_are_taken_as_stored() {
    let folder = Folder::new();
    let noise = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([(x * 6) as u8, (y * 8) as u8, (x * y) as u8]));
    let mut jpeg = std::io::Cursor::new(Vec::new());
    noise.write_to(&mut jpeg, image::ImageFormat::Jpeg).expect("a photo");
    let jpeg = jpeg.into_inner();
    write_transforms(folder.path("c.json"), &[zipsplat_tests::scenes::camera(40, 30)], &["photo.jpg"])
        .expect("a camera");
    let scene = |bytes: &[u8], options: &str| {
        folder.write("photo.jpg", bytes);
        let line =
            format!("reconstruct @/photo.jpg --weights @/micro.safetensors --input-size 28x28 {options} -o @/s.ply");
        folder.run(&line).success();
        read_ply(folder.path("s.ply")).expect("the scene can be read")
    };
    // 90 and 180 degrees.
    for orientation in [6, 3] {
        let turned = with_orientation(&jpeg, orientation);
        assert!(
            scene(&turned, "--cameras @/c.json") == scene(&jpeg, "--cameras @/c.json"),
            "orientation {orientation}"
        );
        assert!(scene(&turned, "") != scene(&jpeg, ""), "orientation {orientation}");
    }
}

#[test]
fn photos_without_cameras_are_left_out_and_named() {
    let folder = Folder::new();
    (2..8).for_each(|i| crate::photo(40, 30, i).save_png(folder.path(&format!("photos/{i}.png"))).expect("a photo"));
    let cameras = [zipsplat_tests::scenes::camera(40, 30); 3];
    write_transforms(folder.path("c.json"), &cameras, &["photos/3.png", "photos/5.png", "gone.png"]).expect("cameras");
    let line = "--weights @/micro.safetensors --input-size 42x28 --json -o @/s.ply --cameras @/c.json";
    let outcome = folder.run(&format!("reconstruct @/photos {line}"));
    let note = "note: 6 photos left out, not among the cameras: 1.png, 2.png, 4.png, 6.png, 7.png, ...\n";
    assert!(outcome.err.contains(note), "{}", outcome.err);
    assert_eq!(outcome.json()["views"], 2);
    let scene = || folder.read("s.ply");
    let left = scene();
    folder.run(&format!("reconstruct @/photos/3.png @/photos/5.png {line}")).success();
    assert!(scene() == left, "the same photos");
    // Before views are selected.
    assert_eq!(folder.run(&format!("reconstruct @/photos {line} --views 2")).json()["views"], 2);
    let line = line.replace(" --json", "");
    folder.run(&format!("reconstruct @/photos/1.png {line}")).fails(3, &["camera of", "1.png", "3.png"]);
}

#[test]
fn cameras_are_poses() {
    let folder = with_cameras();
    let scene = |option: &str| {
        folder
            .run(&format!("reconstruct @/photos --weights seeded:vits --input-size 14x14 {option} -o @/s.ply"))
            .success();
        folder.read("s.ply")
    };
    assert!(scene("--cameras @/c.json") == scene("--poses @/c.json"));
}

#[test]
fn help_has_examples_for_every_command() {
    for command in ["", "reconstruct ", "render ", "doctor ", "convert ", "bench "] {
        assert!(zipsplat(&format!("{command}--help")).success().contains("Examples:\n  zipsplat "), "{command}");
    }
}

#[test]
fn help_is_a_command_too() {
    for command in ["render", "bench tradeoff", "weights get"] {
        assert_eq!(zipsplat(&format!("help {command}")).success(), zipsplat(&format!("{command} --help")).success());
    }
}

#[test]
fn explaining_names_stages_and_what_was_left_out() {
    let folder = Folder::new();
    let line = "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 --explain -o @/s.ply";
    let text = folder.run(line).success();
    for words in ["backbone ", "fuse ", "gaussians ", "every token is kept", "camera encoder", "no cameras are given"] {
        assert!(text.contains(words), "'{words}' is not in: {text}");
    }
    let json = folder.run(&format!("{line} --ratio 0.5 --json")).json();
    let passes = json["explain"]["passes"].as_array().expect("a list");
    let named = |name: &str| passes.iter().find(|pass| pass["pass"] == name);
    assert!(named("cluster").is_some_and(|pass| pass["commands"].as_u64() > Some(0)), "{passes:?}");
    let skipped_passes = json["explain"]["skipped_passes"].as_array().expect("a list");
    assert!(skipped_passes.iter().all(|left| left["what"] != "cluster"), "{skipped_passes:?}");
}

#[test]
fn the_embedded_model_is_the_default() {
    let folder = Folder::new();
    let json = folder.run("reconstruct @/photos --json -o @/scene.ply").json();
    assert_eq!(json["weights"], "the embedded model");
    let side = Checkpoint::builtin().expect("it is built in").image_size();
    assert_eq!((json["width"].as_u64(), json["height"].as_u64()), (Some(side.into()), Some(side.into())));
    let patches = u64::from(side / 14).pow(2);
    assert_eq!(json["tokens"].as_u64(), Some(2 * patches));
    assert!(!read_ply(folder.path("scene.ply")).expect("a scene").is_empty());
    assert_eq!(folder.run("reconstruct @/photos --variant vits -o @/x.ply").code, 2);
}

#[test]
fn pictures_are_those_of_the_two_commands_one_after_the_other() {
    let folder = Folder::new();
    let paths =
        ["--orbit --frames 3 --size 60x40 --depth --alpha", "--dolly --frames 2 --size 40x40 --background white"];
    for (i, path) in paths.into_iter().enumerate() {
        let made = "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -q -o @/s.ply";
        folder.run(&format!("{made} --pictures @/at-once-{i} -- {path}")).success();
        folder.run(&format!("render @/s.ply {path} -q -o @/after-{i}")).success();
        let found = names(&folder.path(&format!("at-once-{i}")));
        assert_eq!(found, names(&folder.path(&format!("after-{i}"))));
        assert!(found.len() > 2);
        for name in &found {
            let read = |at: &str| image::open(folder.path(&format!("{at}-{i}")).join(name)).unwrap().into_rgb16();
            let (at_once, after) = (read("at-once"), read("after"));
            // Rounding of logs and logits may move a value by a level.
            let level = if name.contains("depth") { 1 } else { 257 };
            let most = at_once.as_raw().iter().zip(after.as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(most <= Some(level), "{name:?}: {most:?}");
        }
    }
}

#[test]
fn options_of_pictures_are_checked_before_any_work() {
    let folder = Folder::new();
    let line = "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/s.ply";
    for (drawing, words) in [
        ("--pictures @/out -- --nonesuch", &["zipsplat render", "--nonesuch"][..]),
        ("--pictures @/out -- --orbit --wiggle", &["zipsplat render", "--wiggle"]),
        ("--pictures @/micro.safetensors/out -- --orbit", &["micro.safetensors"]),
    ] {
        folder.run(&format!("{line} {drawing}")).fails(3, words);
    }
    assert!(!folder.path("s.ply").exists());
    assert_eq!(folder.run(&format!("{line} -- --orbit")).code, 2);
}

#[test]
fn results_have_an_envelope_with_warnings() {
    let folder = Folder::new();
    let line = "reconstruct @/photos --weights @/micro.safetensors --input-size 28x28 -o @/out.ply";
    for quiet in ["", "--quiet"] {
        let outcome = folder.run(&format!("{line} --json {quiet}"));
        assert_eq!(outcome.err.contains("note: "), quiet.is_empty(), "{}", outcome.err);
        let json: serde_json::Value = serde_json::from_str(&outcome.success()).expect("JSON");
        assert_eq!((&json["schema_version"], &json["command"]), (&1.into(), &"reconstruct".into()));
        let warnings = json["warnings"].as_array().expect("a list");
        let cropped = |warning: &serde_json::Value| warning.as_str().is_some_and(|text| text.contains("cropped"));
        assert!(warnings.iter().any(cropped) && json["result"]["views"] == 2, "{json}");
    }
}
