use zipsplat::{stages::heads::position_table, types::relative_encoding};
use zipsplat_tests::prelude::*;
use zipsplat_tests::{reference::heads::pixel_shuffle::transposed_convolution, reference::heads::resize};

/// `[channels, pixels]` to `[pixels, channels]`.
fn interleaved(values: &[f64], channels: usize) -> Vec<f64> {
    let pixels = values.len() / channels;
    (0..values.len()).map(|i| values[i % channels * pixels + i / channels]).collect()
}

fn size(text: &str) -> [usize; 2] {
    let (height, width) = text.split_once('x').expect("height x width");
    [height, width].map(|side| side.parse().expect("a number"))
}

#[test]
fn positions() {
    let Some(golden) = Golden::open("da3_units.safetensors") else { return };
    let mut cases = 0;
    for key in golden.keys().iter().filter(|key| key.starts_with("pos/")) {
        let parts: Vec<&str> = key["pos/".len()..].split('_').collect();
        let ([height, width], channels) = (size(parts[0]), parts[1][1..].parse::<usize>().unwrap());
        let picture = size(&parts[2]["image".len()..]);
        let aspect = picture[1] as f64 / picture[0] as f64;
        let truth = interleaved(&golden.f64(key), channels);
        let reference = resize::positions(aspect, [height, width, channels]);
        assert_close(key, &reference, &truth, Tolerance { max: 1e-12, rms: 1e-12 });
        let (table, half) = (position_table(aspect, [height, width, channels]), channels / 2);
        let value = |i: usize| {
            let (pixel, channel) = (i / channels, i % channels);
            let row = if channel < half { pixel % width } else { width + pixel / width };
            table[row * half + channel % half]
        };
        let whole: Vec<f32> = (0..height * width * channels).map(value).collect();
        assert_close(key, &whole, &truth, Tolerance::STORED);
        cases += 1;
    }
    assert!(cases >= 4);
}

#[test]
fn resizing() {
    let Some(golden) = Golden::open("da3_units.safetensors") else { return };
    let cases = golden.keys().into_iter().filter(|key| key.contains("_to_")).collect::<Vec<_>>();
    assert!(cases.len() >= 5);
    for key in cases {
        let (from, to) = key["up/".len()..].split_once("_to_").expect("FROM_to_TO");
        let channels = golden.shape(&key)[0];
        let source = interleaved(&golden.f64(&format!("up/{from}_in")), channels);
        let found = resize::resize(&source, [size(from)[1], channels], size(to));
        assert_close(&key, &found, &interleaved(&golden.f64(&key), channels), Tolerance { max: 1e-12, rms: 1e-12 });
    }
}

#[test]
fn transposed_convolutions() {
    let Some(golden) = Golden::open("da3_units.safetensors") else { return };
    for side in [2, 4] {
        let key = |name: &str| format!("transposed/k{side}_{name}");
        let (inputs, width) = (golden.shape(&key("x"))[0], golden.shape(&key("x"))[2]);
        let narrow = |name: &str| golden.f64(&key(name)).iter().map(|&x| x as f32).collect::<Vec<_>>();
        let (weight, bias) = (narrow("w"), narrow("b"));
        let source = interleaved(&golden.f64(&key("x")), inputs);
        let found = transposed_convolution(&source, [width, side], [&weight, &bias]);
        assert_close(&key("y"), &found, &interleaved(&golden.f64(&key("y")), bias.len()), Tolerance::STORED);
    }
}

#[test]
fn relative_poses() {
    let Some(golden) = Golden::open("da3_tiny.v3_cameras.safetensors") else { return };
    let (extrinsics, intrinsics) = (golden.f64("in/extrinsics"), golden.f64("in/intrinsics"));
    let shape = golden.shape("in/images_u8");
    let camera = |(e, k)| scenes::camera_of([e, k], [shape[3], shape[2]].map(|side| side as u32));
    let cameras: Vec<Camera> = extrinsics.chunks(16).zip(intrinsics.chunks(9)).map(camera).collect();
    let found: Vec<f32> = relative_encoding(&cameras).unwrap().concat();
    assert_close("encoding", &found, &golden.f64("cam/prior_encoding"), Tolerance { max: 1e-6, rms: 5e-7 });
}

/// Exact for averages, within a level for interpolation.
#[test]
fn photos_at_their_size() {
    let Some(golden) = Golden::open("da3_pre.safetensors") else { return };
    let keys = golden.keys().into_iter().filter(|key| key.ends_with("upper_bound_resize")).collect::<Vec<_>>();
    assert!(keys.len() >= 9);
    for key in keys {
        let (name, rest) = key.split_once('/').expect("PHOTO/SIDE_..");
        let Some(path) = zipsplat_tests::golden::find(&format!("{name}.png")) else { continue };
        let photo = zipsplat::Image::open(path).unwrap();
        let bound: u32 = rest.split('_').next().unwrap().parse().unwrap();
        let found = zipsplat::types::bounded(&photo, bound).unwrap();
        let (shape, truth) = (golden.shape(&key), golden.u8(&key));
        assert_eq!([found.height as usize, found.width as usize], shape[..2], "{key}");
        let apart = found.rgb.iter().zip(&truth).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        let means = ["pre_noise_300x900", "pre_up_120x97/56"].iter().any(|alone| key.starts_with(alone));
        assert!(apart <= u8::from(!means), "{key}: off by {apart} levels");
    }
    // 35 is as near to 28 as to 42.
    let photo = zipsplat::Image::new(72, 45, vec![9; 3 * 72 * 45]).unwrap();
    let found = zipsplat::types::bounded(&photo, 56).unwrap();
    assert_eq!([found.width, found.height], [56, 42]);
}
