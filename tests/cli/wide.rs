#![cfg(unix)]

use crate::{
    Folder,
    cameras::{COPIES, OPTIONS_3, colmap, model},
    zipsplat,
};
use image::GrayImage;
use std::fs;
use zipsplat::types::{Camera, Image, Lens, Pose};

const PANOS: &str = "@/place/images --cameras @/place/transforms.json";
const MICRO: &str = "--weights @/micro.safetensors --input-size 28x28";

/// Photos of 64x32 with 8 views each.
fn panoramas(count: usize) -> Folder {
    let folder = Folder::new();
    let size = "--size 32x32 --camera-model equirectangular --wide-size 64x32";
    folder.run(&format!("scene --seed 5 --views {count} {size} -o @/place")).success();
    folder
}

#[test]
fn a_scene_of_fisheyes_is_as_good_as_of_pinhole_photos() {
    let folder = Folder::new();
    let scene = "scene --seed 5 --views 8 --size 40x40";
    folder.run(&format!("{scene} -o @/pinhole")).success();
    folder.run(&format!("{scene} --camera-model opencv-fisheye --wide-size 112x112 -o @/fisheye")).success();
    let psnr = |name: &str, steps: u32| {
        let photos = format!(
            "@/{name}/images --cameras @/{name}/transforms.json --init points --steps {steps} --holdout-views 0"
        );
        let refined = folder.run(&format!("refine {photos} -o @/{name}.ply --json"));
        assert_eq!(refined.err.contains("8 of them, are cut into 40 pinhole views"), name == "fisheye");
        refined.success();
        let evaluated = folder.run(&format!("eval @/pinhole --scene @/{name}.ply --views 2 --lpips none --json"));
        evaluated.json()["mean"]["psnr"].as_f64().expect("dB")
    };
    let (pinhole, fisheye) = (psnr("pinhole", 60), psnr("fisheye", 240));
    assert!(fisheye > pinhole - 1.0, "{fisheye} dB, of pinhole photos {pinhole} dB");
    let mut file: serde_json::Value = serde_json::from_str(&folder.text("fisheye/transforms.json")).expect("JSON");
    file["k1"] = serde_json::json!(-0.15);
    folder.write("fisheye/transforms.json", file.to_string());
    let wrong = psnr("fisheye", 240);
    assert!(wrong < fisheye - 1.0, "{wrong} dB, {fisheye} dB with the right lens");
}

#[test]
fn commands_take_the_views_of_known_panoramas() {
    let folder = panoramas(4);
    let two = folder.run(&format!("--json reconstruct {PANOS} --views 2 {MICRO} --explain -o @/scene.ply"));
    assert!(two.err.contains("4 of them, are cut into 32 pinhole views of 100 degrees"), "{}", two.err);
    assert!(two.out.contains("are cut into 32 pinhole views"), "a warning: {}", two.out);
    assert_eq!(two.json()["views"], 16);
    let planned = folder.run(&format!("reconstruct {PANOS} --views 2 {MICRO} --dry-run --json"));
    assert_eq!(planned.json()["views"], 16);
    let tiles = folder.run(&format!("reconstruct {PANOS} --views 1 {MICRO} --crop tiles -o @/tiles.ply --json"));
    assert_eq!(tiles.json()["views"], 8);
    let json = folder.run(&format!("eval @/place --views 3 {MICRO} --lpips none --json")).json();
    assert_eq!(json["views"].as_array().expect("views").len(), 8, "the views of the fourth: {json}");
    let each = folder.run(&format!("reconstruct @/place --each --cameras capture {MICRO} --views 2 -o @/scenes"));
    each.success();
    let record: serde_json::Value = serde_json::from_str(&folder.text("scenes/place.json")).expect("JSON");
    assert!(record["photos"] == 16 && record["note"].to_string().contains("cut into 32"), "{record}");
    folder.run(&format!("view {PANOS} --views 1 {MICRO} -o @/page.html")).success();
    let depth = format!("depth {PANOS} --weights @/alone.safetensors -o @/depth");
    folder.with_depth().run(&depth).fails(3, &["field of view of images/000.png", "up to 110 degrees"]);
}

#[test]
fn optimized_views_are_written_and_read() {
    let folder = panoramas(3);
    let refine = format!("refine {PANOS} --init points --steps 4");
    let line = format!("{refine} --optimize-cameras --cameras-out @/place/moved.json -o @/scene.ply");
    folder.run(&line).success();
    let moved = folder.capture("place/moved.json");
    let truth = folder.capture("place/transforms.json");
    assert_eq!(moved.frames.len(), 24);
    for (moved, truth) in moved.frames.iter().zip(&truth.frames) {
        assert_eq!((moved.lens, &moved.name), (truth.lens, &truth.name));
        assert!(moved.camera.pose.matrix().abs_diff_eq(truth.camera.pose.matrix(), 0.1));
    }
    folder
        .run(&format!("{refine} --cameras @/place/moved.json -o @/again.ply").replacen(
            "--cameras @/place/transforms.json ",
            "",
            1,
        ))
        .success();
}

fn mask(folder: &Folder, name: &str, edge: u32) {
    folder.make("masks");
    let mask = GrayImage::from_fn(64, 32, |_, y| image::Luma([if y < edge { 255 } else { 0 }]));
    mask.save(folder.path(name)).expect("a mask");
}

#[test]
fn masks_follow_the_views() {
    let folder = panoramas(3);
    (0..3).for_each(|i| mask(&folder, &format!("masks/{i:03}.png"), 16));
    let line = format!("refine {PANOS} --init points --steps 4 --masks @/masks -o @/scene.ply --json");
    let ignored = folder.run(&line).json()["refined"]["masked_fraction"].as_f64().expect("a share");
    assert!((ignored - 0.5).abs() < 0.1, "{ignored}");
}

fn photo_sphere(folder: &Folder, name: &str, image: &Image) {
    let xmp = b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta><GPano:ProjectionType>equirectangular</GPano:ProjectionType>";
    let mut bytes = image.jpeg(95).expect("a JPEG");
    let length = (xmp.len() as u16 + 2).to_be_bytes();
    bytes.splice(2..2, [&[0xff, 0xe1][..], &length, xmp].concat());
    folder.write(name, bytes);
}

#[test]
fn photo_spheres_are_cut_into_photos() {
    let folder = panoramas(2);
    for i in 0..2 {
        let photo = Image::open(folder.path(&format!("place/images/{i:03}.png"))).expect("a photo");
        photo_sphere(&folder, &format!("spheres/{i}.jpg"), &photo);
        mask(&folder, &format!("masks/{i}.png"), 20);
    }
    let (small, micro) = ("--input-size 28x28", "--weights @/micro.safetensors");
    let lens = Lens::equirectangular(64, 32, "photo").expect("a lens");
    let intrinsics = lens.views("photo").expect("views")[0].intrinsics;
    let camera = Camera { intrinsics, pose: Pose::IDENTITY };
    colmap(
        &folder,
        "three",
        "3.8",
        OPTIONS_3,
        ["ls \"$images/0\" >\"$0.names\"; ls \"$images/../masks/0\" >\"$0.masks\"", "", COPIES],
    );
    model(&folder.path("three.model/0"), &[("0/000000.jpg", &camera), ("0/000013.jpg", &camera)]);
    let find = "cameras @/spheres --colmap @/three --masks @/masks -o @/found.json";
    let outcome = folder.run(find);
    assert!(outcome.err.contains("2 of them, are cut into 14 pinhole photos of 100 degrees"), "{}", outcome.err);
    outcome.success();
    assert_eq!(folder.text("three.names").lines().count(), 14, "the views down are masked whole");
    let found: Vec<String> = folder.capture("found.json").frames.into_iter().map(|frame| frame.name).collect();
    assert_eq!(found, ["found.frames/0-0.jpg", "found.frames/1-6.jpg"]);
    assert!(folder.text("three.masks").contains("000013.jpg.png"));
    let names = crate::names(&folder.path("found.frames"));
    assert!(names.len() == 15 && names[0] == "0-0.jpg" && names[14] == "masks", "{names:?}");
    let photo = Image::open(folder.path("spheres/1.jpg")).expect("a photo");
    let lens = Lens { view: 5, ..lens };
    let (view, cut) = (lens.undistort(&photo).expect("a view"), folder.path("found.frames/1-5.jpg"));
    let cut_image = Image::open(&cut).expect("a photo");
    let off = view.rgb.iter().zip(&cut_image.rgb).map(|(a, b)| u32::from(a.abs_diff(*b))).sum::<u32>();
    assert!(off / (view.rgb.len() as u32) < 4, "{off}");
    let bytes = fs::read(&cut).expect("a file");
    let focal = b"\x05\xa4\x03\0\x01\0\0\0\x0f\0";
    assert!(bytes.windows(focal.len()).any(|tag| tag == focal), "no focal length of 15 mm");
    let masked = format!("reconstruct @/spheres {micro} {small} --masks @/masks -o @/masked.ply --json");
    let outcome = folder.run(&masked);
    assert!(outcome.err.contains("into 14 pinhole photos"), "{}", outcome.err);
    let json = outcome.json();
    assert!(json["unmasked_tokens"].as_u64() < json["all_tokens"].as_u64(), "{json}");
    let line = format!("reconstruct @/place/images {micro} {small} -o @/other.ply --json --camera-model");
    assert_eq!(folder.run(&format!("{line} equirectangular --views 1")).json()["views"], 8);
    let line = format!("reconstruct @/spheres {micro} {small} -o @/flat.ply --json --camera-model pinhole");
    assert_eq!(folder.run(&line).json()["views"], 2);
}

#[test]
fn other_photos_are_not_cut() {
    let folder = panoramas(2);
    photo_sphere(&folder, "part/a.jpg", &crate::photo(60, 20, 0));
    let outcome = folder.run(&format!("reconstruct @/part {MICRO} -o @/scene.ply"));
    assert!(outcome.err.contains("panoramas of less than the sphere") && outcome.err.contains("a.jpg"));
    outcome.success();
    let line = format!("reconstruct @/photos {MICRO} -o @/none.ply --camera-model equirectangular");
    folder.run(&line).fails(3, &["photos/1.png", "40x30", "twice as wide as high"]);
    let line = format!("reconstruct {PANOS} {MICRO} -o @/none.ply --camera-model equirectangular");
    folder.run(&line).fails(3, &["--camera-model", "cameras of a file"]);
    photo_sphere(&folder, "whole/a.jpg", &crate::photo(40, 20, 0));
    let refine = "refine @/whole --cameras colmap --init points -o @/none.ply";
    folder.run(refine).fails(3, &["whole/a.jpg", "360-degree", "EQUIRECTANGULAR"]);
    zipsplat("reconstruct a --each -o b --camera-model pinhole").fails_usage();
}
