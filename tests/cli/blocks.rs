use crate::Folder;
use zipsplat::types::Scene;

const MICRO: &str = "--weights @/micro.safetensors --input-size 56x42";

fn place(views: u32) -> Folder {
    let folder = Folder::new();
    folder.run(&format!("scene --seed 5 --views {views} --size 56x42 -o @/place")).success();
    folder
}

#[test]
fn blocks_are_joined_and_refined() {
    let folder = place(10);
    let blocks = "--block-size 5 --block-overlap 2 -o @/scene.ply";
    let known = "@/place/images --cameras @/place/transforms.json";
    for cameras in [known, "@/place/images"] {
        let json = folder.run(&format!("reconstruct {cameras} {MICRO} {blocks} --json")).json();
        let scene = Scene::open(folder.path("scene.ply")).expect("a scene");
        assert_eq!(scene.len(), 10 * 12 * 4, "4 Gaussians for each of 12 patches of a photo");
        assert_eq!((&json["tokens"], &json["all_tokens"]), (&120.into(), &120.into()));
        let found = json["blocks"].as_array().expect("blocks");
        assert_eq!(found.len(), 3);
        for (i, block) in found.iter().enumerate() {
            assert_eq!(block["views"].as_array().map(Vec::len), Some(5));
            assert_eq!(block["seam_error"].is_f64(), i > 0, "{block}");
        }
        let text = folder.run(&format!("reconstruct {cameras} {MICRO} {blocks} --explain")).success();
        assert!(text.contains("3 blocks of 5 views; neighbors share ") && text.contains(" % or less"), "{text}");
    }
    let refine = format!("reconstruct {known} {MICRO} {blocks} --refine=4");
    let json = folder.run(&format!("{refine} --init scene --json")).json();
    assert_eq!((json["refined"]["steps"].as_u64(), json["blocks"].as_array().map(Vec::len)), (Some(4), Some(3)));
    folder.run(&format!("{refine} --refine-target tokens")).fails(3, &["--refine-target tokens", "3 blocks of views"]);
    let one = folder.run(&format!("reconstruct {known} {MICRO} -o @/scene.ply --json")).json();
    assert!(one["blocks"].is_null(), "{one}");
    let eval = format!("eval @/place --views 8 {MICRO} --lpips none --block-size 5 --block-overlap 2 --json");
    assert_eq!(folder.run(&eval).json()["tokens"], 96);
}

#[test]
fn captures_of_a_batch_are_split() {
    let folder = place(5);
    let batch = format!("reconstruct @/place --each --cameras capture {MICRO} --block-size 3 -o @/scenes");
    folder.run(&batch).success();
    let record: serde_json::Value = serde_json::from_str(&folder.text("scenes/place.json")).expect("JSON");
    assert_eq!((record["blocks"].as_array().map(Vec::len), &record["gaussians"]), (Some(2), &240.into()), "{record}");
    let text = folder.run(&batch.replace("--block-size 3", "--block-size 4")).success();
    assert!(text.contains("1 scene made"), "other blocks make another scene: {text}");
}

#[test]
fn thousands_of_photos_are_planned() {
    let folder = Folder::new();
    let plan = "--device none reconstruct --dry-run --weights seeded:vitg --ratio auto --views";
    let json = |options: &str| folder.run(&format!("{plan} {options} --json")).json();
    let (one, many) = (json("192"), json("2000"));
    assert_eq!(one["blocks"], serde_json::json!({ "count": 1, "size": 192, "overlap": 0 }));
    assert_eq!(many["blocks"], serde_json::json!({ "count": 14, "size": 192, "overlap": 48 }));
    let [one, of_all] = [&one, &many].map(|json| json["flops"].as_u64().expect("FLOPs"));
    assert_eq!(of_all, 14 * one);
    assert!(many["peak_bytes"].as_u64().is_some_and(|bytes| bytes < 6_000_000_000), "{}", many["peak_bytes"]);
    let text = folder.run(&format!("{plan} 2000 --block-size 100 --block-overlap 0 --cameras @/none")).success();
    assert!(text.contains("20 blocks of 100 views, 0 shared by neighbors, a pass each"), "{text}");
}

#[test]
fn unusable_blocks_are_refused() {
    let folder = Folder::new().with_depth();
    let two = format!("reconstruct @/photos {MICRO} -o @/scene.ply");
    for (options, words) in [
        ("--block-size 1 --block-overlap 1", ["block overlap: found 1", "less than the block size, 1"]),
        ("--block-size 1", ["block overlap: found 0", "known cameras"]),
        ("--block-size 193", ["block size: found 193", "1 to 192"]),
        ("--block-size 0", ["block size: found 0", "1 to 192"]),
    ] {
        folder.run(&format!("{two} {options}")).fails(3, &words);
        folder.run(&format!("{two} {options} --dry-run")).fails(3, &words);
    }
    let depth = "reconstruct @/photos --weights @/da3.safetensors --block-size 1 -o @/scene.ply";
    folder.run(depth).fails(3, &["--block-size", "Depth Anything 3"]);
    assert!(!folder.path("scene.ply").exists());
}
