use crate::Folder;
use zipsplat::stages::lpips::LpipsNetwork;
use zipsplat::types::{Origin, SaveOptions, Scene, World, write_ply};
use zipsplat_tests::{golden::lpips_weights, scenes};

#[test]
fn devices_are_listed_with_what_they_can_do() {
    let folder = Folder::new();
    let devices = folder.run("doctor list --json").json();
    let usable = |device: &serde_json::Value| device["unusable_reason"].as_array().is_some_and(Vec::is_empty);
    assert!(devices.as_array().is_some_and(|list| list.iter().any(usable)), "{devices}");
    let text = folder.run("doctor list").success();
    assert!(
        text.starts_with("0: ")
            && text.contains("usable")
            && ["subgroup", "16 bits", "matrices"].iter().all(|row| text.contains(row)),
        "{text}"
    );
}

#[test]
fn files_are_told_apart_by_content() {
    let folder = Folder::new();
    folder.scatter("scene.bin", 7, 2, 0.1);
    let scene = folder.run("convert @/scene.bin --json").json();
    assert_eq!((&scene["gaussians"], &scene["sh_degree"]), (&7.into(), &2.into()));
    assert!(scene["bounds"][0][2].as_f64() >= Some(1.0) && scene["bounds"][1][2].as_f64() <= Some(6.0), "{scene}");
    let checkpoint = folder.run("convert @/micro.safetensors --json").json();
    assert_eq!(checkpoint["architecture"]["depth"], 3);
    let (parameters, bytes) = (checkpoint["parameters"].as_u64(), checkpoint["bytes"].as_u64());
    assert_eq!(parameters.map(|count| 4 * count), bytes);
    assert!(folder.run("convert seeded:vitg").success().contains("vitg"));
}

#[test]
fn a_scene_is_told_by_its_ranges() {
    let folder = Folder::new();
    let scene = Scene {
        means: vec![[1.0, -2.0, 3.0], [-4.0, 5.0, 6.0]],
        scales: vec![[0.5, 0.25, 0.125], [0.5, 2.0, 1.0]],
        opacities: vec![0.25, 0.75],
        ..scenes::random_scene(2, 1, 0.1)
    };
    let world = World::from(Origin::Photo("images/7.png".into()));
    scene.save_in(folder.path("a.ply"), &SaveOptions::default(), Some(&world)).expect("a scene can be written");
    write_ply(&scene, folder.path("b.ply")).expect("a scene can be written");
    let text = folder.run("convert @/a.ply").success();
    for words in
        ["2 Gaussians", "degree 1", " B", "-4.000000", "6.000000", "scale", "2.000000", "opacity", "images/7.png"]
    {
        assert!(text.contains(words), "'{words}' is not in: {text}");
    }
    let json = folder.run("convert @/a.ply --json").json();
    assert_eq!(json["bounds"], serde_json::json!([[-4.0, -2.0, 3.0], [1.0, 5.0, 6.0]]));
    let near = |key: &str, range: [f64; 2]| {
        let found = [0, 1].map(|i| json[key][i].as_f64().unwrap_or(f64::NAN));
        assert!((0..2).all(|i| (found[i] - range[i]).abs() < 1e-6), "{key}: {found:?}");
    };
    near("scales", [0.125, 2.0]);
    near("opacities", [0.25, 0.75]);
    assert_eq!(json["bytes"].as_u64(), Some(folder.path("a.ply").metadata().expect("a file").len()));
    assert_eq!(json["world"], "the camera of images/7.png");
    assert!(folder.run("convert @/b.ply --json").json()["world"].is_null());
}

#[test]
fn a_plan_takes_what_a_run_then_takes() {
    let folder = Folder::new();
    for options in [
        "--input-size 28x28",
        "--input-size 70x42 --ratio 0.5",
        "--input-size 28x42 --ratio 0.5 --token-selection stride",
        "--input-size 28x28 --precision fp16",
    ] {
        let shared = format!("--weights @/micro.safetensors {options} --json");
        let plan = folder.run(&format!("reconstruct --dry-run --views 2 {shared}")).json();
        let run = folder.run(&format!("reconstruct @/photos {shared} -o @/scene.ply")).json();
        assert_eq!(plan["peak_bytes"], run["peak_bytes"], "{options}");
        let number = |key: &str| plan[key].as_u64().expect("a number");
        assert_eq!(number("peak_bytes"), number("weight_bytes") + number("scene_bytes") + number("arena_bytes"));
        let rows = plan["rows"].as_array().expect("a row a tensor");
        let end = |row: &serde_json::Value| row["offset"].as_u64().zip(row["bytes"].as_u64()).map(|(o, b)| o + b);
        assert!(rows.len() > 20 && rows.iter().all(|row| end(row) <= plan["arena_bytes"].as_u64()));
    }
    let shared = "--weights @/micro.safetensors --input-size 28x28 --json";
    let plan = folder.run(&format!("reconstruct --dry-run --views 2 {shared} --pictures @/out -- --size 90x60")).json();
    let drawing = "--pictures @/out -- --wiggle --frames 4 --size 90x60";
    let run = folder.run(&format!("reconstruct @/photos {shared} -o @/scene.ply {drawing}")).json();
    assert_eq!(plan["peak_bytes"], run["peak_bytes"]);
    assert!(plan["separate_bytes"].as_u64() > plan["peak_bytes"].as_u64(), "{plan}");
    folder.run("scene --seed 5 --views 9 --size 42x28 -o @/place").success();
    let photos = "@/place/images --cameras @/place";
    for ratio in ["1", "0.5"] {
        let plan =
            folder.run(&format!("reconstruct --dry-run --views 9 --cameras @/place --ratio {ratio} --refine=3 --max-image-size 42x28 {shared}")).json();
        let options = format!("--ratio {ratio} --refine=3 --init scene");
        let run = folder.run(&format!("reconstruct {photos} {options} {shared} -o @/scene.ply --overwrite")).json();
        assert_eq!(plan["peak_bytes"], run["refined"]["peak_bytes"], "{plan}");
        let tokens =
            folder.run(&format!("reconstruct --dry-run --views 9 --cameras @/place --ratio {ratio} --refine=3 --max-image-size 42x28 --refine-target tokens {shared}"));
        let options = format!("--ratio {ratio} --refine=3 --refine-target tokens");
        let run = folder.run(&format!("reconstruct {photos} {options} {shared} -o @/scene.ply --overwrite")).json();
        assert_eq!(tokens.json()["peak_bytes"], run["refined"]["peak_bytes"], "tokens at {ratio}");
        let number = |key: &str| plan[key].as_u64().expect("a number");
        assert!(number("refine_kept_bytes") > 3 * number("scene_bytes") && number("refine_arena_bytes") > 0, "{plan}");
    }
    let more = "--max-gaussians 2000 --optimize-cameras --lpips-weight 0.05";
    let plan = folder
        .run(&format!(
            "reconstruct --dry-run --views 9 --cameras @/place --refine=3 --max-image-size 42x28 {more} {shared}"
        ))
        .json();
    let plain = folder
        .run(&format!("reconstruct --dry-run --views 9 --cameras @/place --refine=3 --max-image-size 42x28 {shared}"))
        .json();
    let kept = |plan: &serde_json::Value| plan["refine_kept_bytes"].as_u64().expect("a number");
    // The convolutions of VGG16, twice.
    assert!(kept(&plan) > kept(&plain) + 2 * 4 * 14_710_464, "{plan}");
    if lpips_weights(LpipsNetwork::Vgg).is_some() {
        let run = format!("reconstruct {photos} --refine=1 --init scene {more} {shared} -o @/more.ply");
        assert_eq!(plan["peak_bytes"], folder.run(&run).json()["refined"]["peak_bytes"], "{plan}");
    }
    let grown_tokens = format!(
        "reconstruct --dry-run --views 9 --cameras @/place --refine=3 --max-image-size 42x28 --refine-target tokens --max-gaussians 2000 {shared}"
    );
    assert_eq!(folder.run(&grown_tokens).code, 3);
    folder.run("scene --seed 5 --views 9 --size 400x384 -o @/large").success();
    let large = "@/large/images --cameras @/large --ratio 0.5 --input-size 28x28";
    folder.run(&format!("reconstruct {large} --weights @/micro.safetensors -o @/scene.ply --overwrite")).success();
    let refine = "refine @/scene.ply @/large/images --cameras @/large --steps 5 -o @/sharp.ply --json";
    let run = folder.run(refine).json();
    let plan = folder
        .run(&format!("reconstruct --dry-run @/large/images --cameras @/large --ratio 0.5 --refine=5 {shared}"))
        .json();
    let wide = |plan: &serde_json::Value| plan["refine_arena_bytes"].as_u64().zip(plan["refine_kept_bytes"].as_u64());
    let planned = wide(&plan).map(|(arena, kept)| arena + kept);
    assert_eq!(planned, run["refined"]["peak_bytes"].as_u64(), "{plan}");
    let kept = |length: &str| {
        let line = format!("reconstruct --dry-run @/large/images --cameras @/large --refine={length} {shared}");
        folder.run(&line).json()["refine_kept_bytes"].as_u64()
    };
    assert!(kept("60s") == kept("800"), "a time may become any number of steps");
    assert!(kept("800") > kept("50") && kept("50") > kept("49"), "more steps grow more");
    let of_tokens = folder.run(&format!("reconstruct --dry-run --views 9 --cameras @/place --refine=3 --max-image-size 42x28 --refine-target tokens {shared}")).json();
    assert!(of_tokens["refine_kept_bytes"].as_u64() > Some(0), "{of_tokens}");
    assert_eq!(
        folder
            .run(&format!(
                "reconstruct --dry-run --views 9 --cameras @/place --refine --refine-target cameras {shared}"
            ))
            .code,
        2
    );
    let line = "reconstruct --dry-run --views 3 --weights seeded:vitg --ratio auto --cameras @/place";
    let (top, all) = (folder.run(line).success(), folder.run(&format!("{line} --explain")).success());
    assert!(top.lines().count() < 30 && all.lines().count() > 50 && top.contains("--explain shows them"), "{top}");
}

#[test]
fn the_largest_network_takes_192_views_within_its_memory() {
    let folder = Folder::new();
    for (precision, most) in [("fp16", 6_000_000_000), ("fp32", 12_000_000_000)] {
        let options = format!("--views 192 --weights seeded:vitg --precision {precision} --json");
        let plan = folder.run(&format!("--device none reconstruct --dry-run {options}")).json();
        assert_eq!(plan["precision"], precision);
        assert!(plan["peak_bytes"].as_u64().is_some_and(|bytes| bytes <= most), "{precision}: {}", plan["peak_bytes"]);
    }
}
