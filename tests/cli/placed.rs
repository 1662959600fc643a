use crate::Folder;
use zipsplat::types::{Image, poses::write_transforms, read_world};
use zipsplat_tests::{photos::with_orientation, scenes::camera};

const LINE: &str = "--weights @/micro.safetensors --input-size 84x84 -o @/scene.ply";

#[test]
fn cameras_follow_from_the_scene() {
    let folder = Folder::new();
    folder.make("wide");
    for (name, seed) in [("a", 1), ("b", 5)] {
        crate::photo(160, 100, seed).save_png(folder.path(&format!("wide/{name}.png"))).expect("a photo");
    }
    let line = format!("reconstruct @/wide {LINE} --cameras-out @/new/dir/found.json --json");
    let json = folder.run(&line).json();
    let cameras = json["estimated_cameras"].as_array().expect("one a photo");
    let poses = folder.capture("new/dir/found.json");
    assert_eq!(
        (cameras.len(), poses.frames.len()),
        (2, cameras.iter().filter(|camera| !camera.is_null()).count()),
        "{json}"
    );
    let file: serde_json::Value = serde_json::from_slice(&folder.read("new/dir/found.json")).expect("JSON");
    for (frame, entry) in poses.frames.iter().zip(file["frames"].as_array().expect("frames")) {
        let lens = frame.camera.intrinsics;
        assert_eq!((lens.width, lens.height, lens.cx, lens.cy), (160, 100, 80.0, 50.0));
        assert!(Image::open(frame.photo.as_ref().expect("the photo")).is_ok());
        assert!(entry["inliers"].as_u64() >= Some(6) && entry["patches"] == 36, "{entry}");
    }
    assert!(json["stage_seconds"]["find cameras"].is_f64() && !folder.path("new/dir/points.ply").exists());
    let before = folder.read("new/dir/found.json");
    let text = folder.run(&line.replace("--json", "--overwrite")).success();
    assert!(text.contains("of a photo's patches agree"), "{text}");
    assert!(before == folder.read("new/dir/found.json"));
}

#[test]
fn photos_too_small_for_cameras_are_told() {
    let folder = Folder::new();
    let line = format!("reconstruct @/photos {} --cameras-out @/found.json", LINE.replace("84x84", "28x28"));
    folder.run(&line).fails(3, &["found.json", "found none", "4", "6 or more"]);
    assert!(folder.path("scene.ply").exists() && !folder.path("found.json").exists());
    folder.run(&line.replace("found.json", "new/found.json")).fails(3, &["found none"]);
    assert!(!folder.path("new").exists());
    folder.run(&line.replace("found.json", "found.txt")).fails(3, &["found.txt", ".json"]);
    folder.write("found.json", "another's");
    folder.run(&line).fails(3, &["file to replace", "found.json", "--overwrite"]);
}

#[test]
fn photos_that_are_given_tell_which_way_is_up() {
    let folder = Folder::new();
    let jpeg = crate::photo(40, 30, 0).jpeg(90).expect("a photo");
    folder.write("images/photo.jpg", with_orientation(&jpeg, 6));
    folder.make("elsewhere");
    folder.scatter("points.ply", 50, 0, 0.1);
    for place in ["images", "elsewhere"] {
        let file = format!("{place}/c.json");
        write_transforms(folder.path(&file), &[camera(40, 30)], &["photo.jpg"]).expect("a camera");
        let photos = format!("@/images/photo.jpg --cameras @/{file} -o @/scene.ply");
        for line in [
            format!("reconstruct {photos} --weights @/micro.safetensors --input-size 28x28"),
            format!("refine @/points.ply {photos} --steps 1"),
        ] {
            folder.run(&line).success();
            let up = read_world(folder.path("scene.ply")).expect("a scene").and_then(|world| world.up);
            assert!(up.is_some_and(|up| up.x.abs() > 0.99), "{line}: {up:?}");
        }
    }
}
