use crate::Folder;
use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, WritableImage};
use half::f16;
use std::path::Path;
use zipsplat::Scene;

const PHOTOS: &str = "@/place/images --cameras @/place/transforms.json";

/// Exact depth is in `@/place/depth`.
fn place() -> Folder {
    let folder = Folder::new();
    folder.run("scene --seed 5 --views 6 --size 42x28 -o @/place").success();
    folder
}

fn values(folder: &Folder, number: usize) -> Vec<f32> {
    let bytes = folder.read(&format!("place/depth/{number:03}.npy"));
    bytes[128..].as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

fn save_levels(path: &Path, [width, height]: [u32; 2], values: &[f32]) {
    let levels = values.iter().map(|value| (1000.0 * value).round() as u16).collect();
    let picture = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_raw(width, height, levels);
    picture.expect("as many levels").save(path).expect("written");
}

fn save_exr<const N: usize>(path: &Path, channels: [(&str, FlatSamples); N]) {
    let channels = channels.map(|(name, values)| AnyChannel::new(name, values));
    let image = exr::prelude::Image::from_channels((42, 28), AnyChannels::sort(channels.into_iter().collect()));
    image.write().to_file(path).expect("written");
}

#[test]
fn known_depth_joins_the_loss() {
    let folder = place().with_depth();
    let line = |options: &str| {
        let start = "--init points --steps 12 --holdout-views 0";
        format!("refine {PHOTOS} {start} -o @/scene.ply --overwrite {options}")
    };
    let refined = |options: &str| {
        let json = folder.run(&line(&format!("{options} --json"))).json();
        (json["refined"]["depth_fraction"].as_f64().expect("a number"), folder.read("scene.ply"))
    };
    let (none, without) = refined("");
    let (all, metric) = refined("--depth-loss @/place/depth");
    assert!(none == 0.0 && all > 0.5 && metric != without, "{all}");
    assert!(metric == refined("--depth-loss @/place/depth").1, "bits differ from run to run");
    assert!(without == refined("--depth-loss @/place/depth --depth-weight 0").1);
    // Named after the whole file, as masks may be.
    folder.make("long");
    for i in 0..6 {
        let [from, to] =
            [format!("place/depth/{i:03}.npy"), format!("long/{i:03}.png.npy")].map(|name| folder.path(&name));
        std::fs::copy(from, to).expect("copied");
    }
    assert!(metric == refined("--depth-loss @/long").1);
    folder.make("exr");
    for i in 0..6 {
        let alpha = ("A", FlatSamples::F16(vec![f16::ONE; 42 * 28]));
        save_exr(&folder.path(&format!("exr/{i:03}.exr")), [alpha, ("Z", FlatSamples::F32(values(&folder, i)))]);
    }
    assert!(metric == refined("--depth-loss @/exr").1);
    for i in 0..6 {
        let values = values(&folder, i).into_iter();
        let values = match i % 2 {
            0 => FlatSamples::F16(values.map(f16::from_f32).collect()),
            _ => FlatSamples::U32(values.map(|value| value.round() as u32).collect()),
        };
        save_exr(&folder.path(&format!("exr/{i:03}.exr")), [("distance", values)]);
    }
    assert!(refined("--depth-loss @/exr").0 > 0.5 && folder.read("scene.ply") != metric);
    // As in nerfstudio.
    let listed = folder.text("place/transforms.json");
    let name = |i: usize| format!("\"file_path\": \"images/{i:03}.png\"");
    let with_depth = |text: String, i: usize| {
        text.replace(&name(i), &format!("{}, \"depth_file_path\": \"depth/{i:03}.npy\"", name(i)))
    };
    folder.write("place/depths.json", (0..6).fold(listed, with_depth));
    assert!(metric == refined("--depth-loss @/place/depths.json").1);
    folder.run(&line("--depth-loss @/place/transforms.json")).fails(3, &["transforms.json", "depth_file_path"]);
    std::fs::create_dir(folder.path("levels")).expect("a folder");
    (0..3).for_each(|i| save_levels(&folder.path(&format!("levels/{i:03}.png")), [42, 28], &values(&folder, i)));
    let outcome = folder.run(&line("--depth-loss @/levels --explain"));
    assert!(outcome.err.contains("photos without depth: 003.png"), "{}", outcome.err);
    let text = outcome.success();
    assert!(text.contains("in the cameras' unit; weight 2") && folder.read("scene.ply") != metric, "{text}");
    folder.run("depth @/place/images --weights @/da3.safetensors --input-size 42 -o @/predicted").success();
    let text = folder.run(&line("--depth-loss @/predicted --explain")).success();
    let from_file = folder.read("scene.ply");
    assert!(text.contains("100.0 % of the pixels, relative") && from_file != without, "{text}");
    let (all, predicted) = refined("--depth-loss @/da3.safetensors");
    assert!(all == 1.0 && predicted != without);
}

#[test]
fn evaluations_and_reconstructions_take_known_depth() {
    let folder = place();
    let micro = "--weights @/micro.safetensors --input-size 28x28 --refine 5 --init points";
    let eval = format!("eval @/place --views 3 --lpips none {micro} -o @/out --overwrite --json");
    let psnr = |options: &str| folder.run(&format!("{eval} {options}")).json()["mean"]["psnr"].as_f64().expect("dB");
    assert!(psnr("") != psnr("--depth-loss @/place/depth"));
    assert!(psnr("") != psnr("--antialiased"));
    let reconstruct = format!("reconstruct {PHOTOS} {micro} --depth-loss @/place/depth --antialiased");
    let json = folder.run(&format!("{reconstruct} -o @/scene.ply --json")).json();
    assert!(json["refined"]["depth_fraction"].as_f64() > Some(0.5), "{json}");
    assert!(Scene::open(folder.path("scene.ply")).expect("a scene").antialiased);
    let bytes = |options: &str| {
        let json = folder.run(&format!("reconstruct {PHOTOS} --dry-run {micro} {options} --json")).json();
        json["refine_arena_bytes"].as_u64().expect("bytes")
    };
    assert!(bytes("--depth-loss @/place/depth") > bytes(""));
}

#[test]
fn photos_of_equal_names_have_depth_of_their_own() {
    let folder = place().with_depth();
    for (i, name) in [(0, "left"), (3, "right")] {
        let photo = folder.read(&format!("place/images/{i:03}.png"));
        folder.write(&format!("place/{name}/000.png"), photo);
        let listed = folder.text("place/transforms.json");
        folder.write("place/transforms.json", listed.replace(&format!("images/{i:03}"), &format!("{name}/000")));
    }
    let photos = "@/place/left @/place/right";
    let refine = format!("refine {photos} --cameras @/place/transforms.json --init points --steps 2 -o @/s.ply");
    let shared = folder.run(&format!("{refine} --depth-loss @/place/depth"));
    shared.fails(3, &["values of right/000.png", "000.npy, as of left/000.png"]);
    let eval = "eval @/place --views 5 --weights @/micro.safetensors --input-size 28x28 --from-depth @/place/depth";
    folder.run(eval).fails(3, &["values of right/000.png", "a file of its own"]);
    folder.run(&format!("depth {photos} --weights @/da3.safetensors --input-size 42 -o @/predicted")).success();
    let json = folder.run(&format!("{refine} --depth-loss @/predicted --json")).json();
    assert_eq!(json["refined"]["depth_fraction"].as_f64(), Some(1.0), "{json}");
}

#[test]
fn unusable_depth_is_named() {
    let folder = place();
    let fails = |options: &str, words: &[&str]| {
        folder.run(&format!("refine {PHOTOS} --init points --steps 2 -o @/scene.ply {options}")).fails(3, words);
    };
    std::fs::create_dir(folder.path("other")).expect("a folder");
    fails("--depth-loss @/other", &["other", "none for 000.png", "NAME.npy"]);
    fails("--depth-loss nowhere", &["nowhere", "da3-small"]);
    let mut bytes = folder.read("place/depth/000.npy");
    bytes[128 + 4 * 43..][..4].copy_from_slice(&f32::NAN.to_le_bytes());
    folder.write("other/000.npy", &bytes);
    fails("--depth-loss @/other", &["000.npy", "NaN at column 1, row 1", "0 if unknown"]);
    std::fs::remove_file(folder.path("other/000.npy")).expect("removed");
    save_levels(&folder.path("other/000.png"), [30, 28], &[1.0; 30 * 28]);
    fails("--depth-loss @/other", &["000.png", "30x28", "42x28"]);
    image::GrayImage::new(42, 28).save(folder.path("other/000.png")).expect("written");
    fails("--depth-loss @/other", &["000.png", "L8", "16-bit"]);
    std::fs::remove_file(folder.path("other/000.png")).expect("removed");
    let zeros = || FlatSamples::F32(vec![0.0; 42 * 28]);
    save_exr(&folder.path("other/000.exr"), [("B", zeros()), ("G", zeros())]);
    fails("--depth-loss @/other", &["000.exr", "channels B, G", "Z, Y, R or V"]);
    save_exr(&folder.path("other/000.exr"), [("Z", FlatSamples::F32(vec![f32::INFINITY; 42 * 28]))]);
    fails("--depth-loss @/other", &["000.exr", "inf at column 0, row 0", "0 if unknown"]);
    let whole = folder.read("other/000.exr");
    for length in [0, 4, 100, whole.len() - 1] {
        folder.write("other/000.exr", &whole[..length]);
        fails("--depth-loss @/other", &["000.exr", "an OpenEXR image"]);
    }
    folder.run(&format!("reconstruct {PHOTOS} --depth-loss @/place/depth -o @/scene.ply")).fails_usage();
    folder.run(&format!("refine {PHOTOS} --init points --depth-weight 1 -o @/scene.ply")).fails_usage();
}
