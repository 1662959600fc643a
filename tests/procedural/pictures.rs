use crate::{capture, options};
use rayon::ThreadPoolBuilder;
use zipsplat_cli::procedural::{Options, Photos, Setup};
use zipsplat_tests::prelude::*;

#[test]
fn a_seed_gives_the_same_on_any_number_of_threads() {
    for seed in 0..8 {
        let on = |threads| {
            let pool = ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| capture(seed, &options(4, 40)))
        };
        let [one, two] = [1, 2].map(on);
        assert_eq!(one, two, "seed {seed}");
        assert_ne!(one.images, capture(seed + 1, &options(4, 40)).images, "seeds {seed} and {}", seed + 1);
    }
}

#[test]
fn beginning_elsewhere_keeps_the_place() {
    let turned = Options { random_first: true, ..options(6, 32) };
    let count =
        (0..10).filter(|seed| capture(*seed, &turned).cameras != capture(*seed, &options(6, 32)).cameras).count();
    assert!(count >= 5, "{count} of 10 scenes begin at another view");
}

fn reduced(image: &Image) -> Vec<f64> {
    let (width, height) = (image.width as usize / 4, image.height as usize / 4);
    let block = |x: usize, y: usize, c: usize| {
        let pixels = (0..16).map(|k| ((4 * y + k / 4) * image.width as usize + 4 * x + k % 4) * 3 + c);
        pixels.map(|at| f64::from(image.rgb[at])).sum::<f64>() / 16.0
    };
    (0..height)
        .flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| (x, y, c))))
        .map(|(x, y, c)| block(x, y, c))
        .collect()
}

/// Mean difference, of 255, of a small picture from a downscaled large one.
fn filter_error(seed: u64, supersample: bool) -> f64 {
    let [small, large] = [48, 192].map(|side| capture(seed, &Options { supersample, ..options(3, side) }));
    let pairs = small.images.iter().zip(&large.images).flat_map(|(small, large)| {
        small.rgb.iter().map(|value| f64::from(*value)).zip(reduced(large)).map(|(a, b)| (a - b).abs())
    });
    let errors: Vec<f64> = pairs.collect();
    errors.iter().sum::<f64>() / errors.len() as f64
}

#[test]
fn small_pictures_are_averages_of_large_ones() {
    let mean = |supersample| (0..12).map(|seed| filter_error(seed, supersample)).sum::<f64>() / 12.0;
    let (fast, fine) = (mean(false), mean(true));
    assert!(fast < 6.0, "one ray a pixel differs from 16 by {fast:.2} of 255");
    assert!(fine < fast, "four rays a pixel differ by {fine:.2}, one by {fast:.2}");
}

fn crop(folder: &std::path::Path, name: &str, width: u32, height: u32) {
    let rgb = (0..width * height).flat_map(|k| [(k % 251) as u8, (k * 7 % 256) as u8, 200]).collect();
    Image::new(width, height, rgb).expect("a picture").save_png(folder.join(name)).expect("it can be written");
}

fn manifest(entries: &[(&str, &str)]) -> String {
    let entry = |(file, class): &(&str, &str)| {
        format!(r#"{{"file": "{file}", "repo": "r", "licence": "l", "licence_class": "{class}", "x": 1}}"#)
    };
    format!("[{}]", entries.iter().map(entry).collect::<Vec<_>>().join(", "))
}

#[test]
fn only_permissive_crops_are_read_and_show_in_scenes() {
    let folder = tempfile::tempdir().expect("a folder");
    crop(folder.path(), "free.png", 32, 32);
    fs::write(
        folder.path().join("manifest.json"),
        manifest(&[("free.png", "permissive"), ("not.png", "noncommercial")]),
    )
    .expect("a manifest");
    let photos = Photos::open(folder.path()).expect("one crop");
    assert_eq!(photos.crops.iter().map(|crop| crop.file.as_str()).collect::<Vec<_>>(), ["free.png"]);
    let with = |photos: &Photos| {
        let setup = Setup::new(5, &options(2, 32), photos, &|| Ok(())).expect("options");
        setup.shoot(photos, &|| Ok(())).expect("nothing stops it")
    };
    assert_ne!(with(&photos).images, with(&Photos::default()).images);
}

#[test]
fn unusable_crops_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    crop(folder.path(), "wide.png", 32, 16);
    let opened = |text: &str| {
        fs::write(folder.path().join("manifest.json"), text).expect("a manifest");
        Photos::open(folder.path()).err().expect("an error").to_string()
    };
    assert!(opened(&manifest(&[("wide.png", "permissive")])).contains("square"));
    assert!(opened(&manifest(&[("wide.png", "sharealike")])).contains("permissive"));
    assert!(opened(&manifest(&[("lost.png", "permissive")])).contains("lost.png"));
    assert!(opened("[{}]").contains("manifest.json"));
}
