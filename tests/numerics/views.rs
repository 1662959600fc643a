use crate::{Mode, model, modes, noise, reconstruct};
use image::{DynamicImage, ImageFormat};
use zipsplat_tests::prelude::*;

const SIDE: u32 = 56;

fn plain(level: u8) -> Image {
    Image::new(SIDE, SIDE, vec![level; (3 * SIDE * SIDE) as usize]).unwrap()
}

#[track_caller]
fn assert_sound(name: &str, scene: &Scene, tokens: usize) {
    scene.validate().unwrap_or_else(|error| panic!("{name}: {error}"));
    assert_eq!(scene.len(), tokens * model().architecture().gaussians_per_token, "{name}");
    for quat in &scene.quats {
        let length: f32 = quat.iter().map(|q| q * q).sum();
        assert!((length - 1.0).abs() < 1e-5, "{name}: a rotation of length {length}");
    }
    assert!(scene.scales.as_flattened().iter().all(|s| (1e-6..=15.0).contains(s)), "{name}: scales");
}

#[test]
fn uniform_identical_and_noisy_views() {
    let corrupted = || [noise(SIDE, SIDE, 1), noise(SIDE, SIDE, 2), plain(0), noise(SIDE, SIDE, 4)].to_vec();
    let sets: [(&str, Vec<Image>); 7] = [
        ("one view", vec![noise(SIDE, SIDE, 1)]),
        ("black", vec![plain(0); 3]),
        ("white", vec![plain(255); 3]),
        ("black and white", vec![plain(0), plain(255)]),
        ("identical", vec![noise(SIDE, SIDE, 7); 4]),
        ("one corrupted among many", corrupted()),
        ("one patch", vec![noise(14, 14, 3)]),
    ];
    for (name, images) in sets {
        let grid = (images[0].width / 14 * (images[0].height / 14)) as usize;
        let tokens = images.len() * grid;
        let exact = reconstruct(model(), &images, &ReconstructOptions::default()).to_scene().unwrap();
        for mode in modes() {
            let scene = mode.reconstruct(&images, &ReconstructOptions::default());
            assert_sound(name, &scene, tokens);
            assert_near(name, &scene, &exact, mode);
            for ratio in [0.5, 1e-9] {
                // Clusters are empty.
                let request = ReconstructOptions { ratio: Ratio::Fixed(ratio), ..ReconstructOptions::default() };
                let kept = ((tokens as f64 * ratio) as usize).max(1);
                assert_sound(name, &mode.reconstruct(&images, &request), kept);
            }
        }
    }
}

#[test]
fn the_most_views() {
    let images: Vec<Image> = (0..192).map(|i| noise(SIDE, SIDE, i)).collect();
    let all = |mode: &Mode| mode.reconstruct(&images, &ReconstructOptions::default());
    let exact = all(&modes()[0]);
    assert_sound("192 views", &exact, 192 * 16);
    for mode in &modes()[1..] {
        assert_near("192 views", &all(mode), &exact, mode);
    }
    let request = ReconstructOptions { ratio: Ratio::Auto, ..ReconstructOptions::default() };
    let scene = reconstruct(model(), &images, &request).to_scene().unwrap();
    assert_sound("192 views, clustered", &scene, scene.len() / model().architecture().gaussians_per_token);
}

#[track_caller]
fn assert_near(name: &str, scene: &Scene, exact: &Scene, mode: &Mode) {
    for ((field, got), (_, expected)) in scenes::fields(scene).into_iter().zip(scenes::fields(exact)) {
        assert_close(&format!("{name}, {field}"), got, expected, mode.tolerance(field));
    }
}

fn opened(bytes: &[u8]) -> Image {
    read_as("photo", bytes, |path| Image::open(path).unwrap())
}

/// 8 x 8 pixels of 128 + `level`, baseline, with Adobe's marker of inverted values.
fn cmyk_jpeg(level: i32) -> Vec<u8> {
    let mut out = vec![0xff, 0xd8];
    let mut segment = |marker: u8, body: &[u8]| {
        out.extend([0xff, marker]);
        out.extend((body.len() as u16 + 2).to_be_bytes());
        out.extend(body);
    };
    segment(0xee, b"Adobe\x00\x64\x00\x00\x00\x00\x00");
    segment(0xdb, &[&[0u8][..], &[1; 64]].concat());
    segment(0xc0, &[8, 0, 8, 0, 8, 4, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0, 4, 0x11, 0]);
    // One 1-bit code each: 10-bit differences for DC, end of block for AC.
    let table = |class: u8, symbol: u8| [&[class, 1][..], &[0; 15], &[symbol]].concat();
    segment(0xc4, &table(0x00, 10));
    segment(0xc4, &table(0x10, 0));
    segment(0xda, &[4, 1, 0, 2, 0, 3, 0, 4, 0, 0, 63, 0]);
    let dc = 8 * level;
    assert!((512..1024).contains(&dc.abs()), "needs 10 bits");
    let code = if dc < 0 { dc + 1023 } else { dc } as u64;
    let (mut bits, mut count) = (0u64, 0);
    for _ in 0..4 {
        bits = bits << 12 | code << 1;
        count += 12;
    }
    let padding = (8 - count % 8) % 8;
    bits = bits << padding | ((1 << padding) - 1);
    for i in (0..(count + padding) / 8).rev() {
        let byte = (bits >> (8 * i)) as u8;
        out.push(byte);
        if byte == 0xff {
            out.push(0);
        }
    }
    out.extend([0xff, 0xd9]);
    out
}

#[test]
fn gray_deep_transparent_and_cmyk_photos() {
    let rgb = DynamicImage::ImageRgb8(image::RgbImage::from_fn(60, 60, |x, y| image::Rgb([x as u8, y as u8, 99])));
    let kinds = [
        ("gray", DynamicImage::ImageLuma8(rgb.to_luma8()), ImageFormat::Png),
        ("gray JPEG", DynamicImage::ImageLuma8(rgb.to_luma8()), ImageFormat::Jpeg),
        ("gray and alpha", DynamicImage::ImageLumaA8(rgb.to_luma_alpha8()), ImageFormat::Png),
        ("16 bits", DynamicImage::ImageRgb16(rgb.to_rgb16()), ImageFormat::Png),
        ("16 bits and alpha", DynamicImage::ImageRgba16(rgb.to_rgba16()), ImageFormat::Png),
        ("alpha", DynamicImage::ImageRgba8(rgb.to_rgba8()), ImageFormat::WebP),
    ];
    for (name, picture, format) in kinds {
        let photo = opened(&encoded(&picture, format));
        assert_eq!((photo.width, photo.height), (60, 60), "{name}");
        let view = photo.crop(2, 2, SIDE, SIDE).unwrap();
        assert_sound(name, &reconstruct(model(), &[view], &ReconstructOptions::default()).to_scene().unwrap(), 16);
    }
    // Inverted values multiply.
    for (level, expected) in [(127, 255u8), (-127, 0)] {
        let photo = opened(&cmyk_jpeg(level));
        assert_eq!((photo.width, photo.height), (8, 8));
        assert!(photo.rgb.iter().all(|v| v.abs_diff(expected) <= 1), "CMYK {level}: {:?}", &photo.rgb[..3]);
    }
}

#[test]
fn photos_of_8k() {
    let large = DynamicImage::ImageRgb8(image::RgbImage::from_fn(7680, 4320, |x, y| {
        image::Rgb([(x >> 5) as u8, (y >> 5) as u8, ((x ^ y) >> 6) as u8])
    }));
    let photo = opened(&encoded(&large, ImageFormat::Jpeg));
    assert_eq!((photo.width, photo.height), (7680, 4320));
    let view = zipsplat::types::preprocess::fit(&photo, SIDE, SIDE).unwrap().image;
    assert_sound("8K", &reconstruct(model(), &[view], &ReconstructOptions::default()).to_scene().unwrap(), 16);
}
