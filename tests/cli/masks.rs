use crate::{Folder, zipsplat};
use image::{GrayImage, RgbImage, RgbaImage};
use zipsplat::types::{Image, Scene};

/// Masks hide the left thirds of 10 photos.
fn place() -> Folder {
    let folder = Folder::new();
    folder.run("scene --seed 5 --views 10 --size 42x28 -o @/place").success();
    folder.make("masks");
    for i in 0..10 {
        mask(&folder, &format!("masks/{i:03}.png"), 42, 14);
    }
    folder
}

/// 0 in the columns before `edge`.
fn mask(folder: &Folder, name: &str, width: u32, edge: u32) {
    let mask = GrayImage::from_fn(width, 28, |x, _| image::Luma([if x < edge { 0 } else { 255 }]));
    mask.save(folder.path(name)).expect("a mask");
}

const REFINE: &str = "refine @/place/images --cameras @/place/transforms.json --init points --steps 12 --exposure on";

#[test]
fn masked_pixels_have_no_influence() {
    let folder = place();
    let run = |photos: &str, options: &str, out: &str| {
        folder.run(&format!("{} {options} -o @/{out} --json", REFINE.replace("@/place/images", photos))).json()
    };
    let json = run("@/place/images", "--masks @/masks --explain", "masked.ply");
    assert_eq!(json["refined"]["masked_fraction"], 1.0 / 3.0);
    let passes = json["explain"]["passes"].to_string();
    assert!(passes.contains("loss/mask"), "{passes}");
    for i in 0..10 {
        folder.make("other");
        folder.make("alpha");
        let mut photo = image::open(folder.path(&format!("place/images/{i:03}.png"))).expect("a photo").to_rgb8();
        let alpha = |x: u32, photo: &RgbImage, y: u32| {
            let [r, g, b] = photo.get_pixel(x, y).0;
            image::Rgba([r, g, b, if x < 14 { 0 } else { 255 }])
        };
        RgbaImage::from_fn(42, 28, |x, y| alpha(x, &photo, y))
            .save(folder.path(&format!("alpha/{i:03}.png")))
            .expect("a photo");
        (0..14 * 28).for_each(|at| photo.put_pixel(at % 14, at / 14, image::Rgb([255, (at % 256) as u8, 0])));
        photo.save(folder.path(&format!("other/{i:03}.png"))).expect("a photo");
        // COLMAP's name, with 0 for the pixels to keep.
        let inverted = GrayImage::from_fn(42, 28, |x, _| image::Luma([if x < 14 { 7 } else { 0 }]));
        folder.make("inverted");
        inverted.save(folder.path(&format!("inverted/{i:03}.png.png"))).expect("a mask");
    }
    run("@/other", "--masks @/inverted --invert-masks", "other.ply");
    run("@/alpha", "--masks alpha", "alpha.ply");
    run("@/place/images", "", "unmasked.ply");
    let [masked, other, alpha, unmasked] = ["masked", "other", "alpha", "unmasked"]
        .map(|name| Scene::open(folder.path(&format!("{name}.ply"))).expect("a scene"));
    assert!(masked == other && masked == alpha && masked != unmasked);
}

#[test]
fn masked_patches_have_no_gaussians() {
    let folder = place();
    let line = "reconstruct @/place/images --cameras @/place --weights @/micro.safetensors --input-size 42x28";
    let json = folder.run(&format!("{line} --masks @/masks -o @/scene.ply --json")).json();
    assert_eq!((json["tokens"].as_u64(), json["unmasked_tokens"].as_u64()), (Some(60), Some(40)), "{json}");
    let each = json["gaussians_per_token"].as_u64().expect("a number");
    assert_eq!(json["gaussians"].as_u64(), Some(40 * each));
    let tokens = format!("{line} --masks @/masks --refine 2 --refine-target tokens");
    let refined = folder.run(&format!("{tokens} -o @/refined.ply --json")).json();
    assert_eq!(refined["gaussians"], json["gaussians"]);
    std::fs::rename(folder.path("masks"), folder.path("place/masks")).expect("a folder");
    let each = "reconstruct @/place --each --cameras capture --weights @/micro.safetensors --input-size 42x28";
    folder.run(&format!("{each} --masks masks -o @/scenes")).success();
    assert!(
        Scene::open(folder.path("scenes/place.ply")).expect("a scene").len()
            == Scene::open(folder.path("scene.ply")).expect("a scene").len()
    );
}

#[test]
fn scores_are_of_kept_pixels() {
    let folder = place();
    folder.make("black");
    for i in 0..10 {
        let mut photo = Image::open(folder.path(&format!("place/images/{i:03}.png"))).expect("a photo");
        photo.rgb.chunks_exact_mut(3 * 42).for_each(|row| row[..3 * 14].fill(0));
        photo.save_png(folder.path(&format!("black/{i:03}.png"))).expect("a photo");
    }
    let compared = |masks: &str| {
        folder.run(&format!("eval @/black @/place/images {masks} --lpips none --json")).json()["mean"].clone()
    };
    let masked = compared("--masks @/masks");
    assert!(masked["psnr"].is_null() && masked["ssim"] == 1.0, "{masked}");
    assert!(compared("")["ssim"].as_f64() < Some(0.99));
    let line = "eval @/place --views 7 --weights @/micro.safetensors --input-size 42x28 --lpips none --json";
    let [with, without] =
        ["--masks @/masks", ""].map(|masks| folder.run(&format!("{line} {masks}")).json()["mean"].clone());
    assert!(with["psnr"].is_number() && with != without, "{with}");
}

#[test]
fn unusable_masks_are_named() {
    let folder = place();
    let refused = |words: &[&str]| folder.run(&format!("{REFINE} --masks @/masks -o @/scene.ply")).fails(3, words);
    mask(&folder, "masks/003.png", 40, 14);
    refused(&["size of the mask", "masks/003.png", "40x28", "42x28", "images/003.png"]);
    mask(&folder, "masks/003.png", 42, 42);
    refused(&["masks/003.png", "none", "inverted"]);
    folder.write("masks/003.png", b"no picture");
    refused(&["masks/003.png", "PNG"]);
    folder.remove("masks/003.png");
    refused(&["mask of", "images/003.png", "masks/003.png", "masks/003.png.png"]);
    folder.run(&format!("{REFINE} --masks alpha -o @/scene.ply")).fails(3, &["images/000.png", "no alpha channel"]);
    zipsplat("refine photos --invert-masks -o scene.ply --cameras a.json").fails_usage();
}
