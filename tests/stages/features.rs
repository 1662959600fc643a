//! Features against a brute-force reference in f64, where every pixel visits every Gaussian.

use zipsplat::features::{FeatureRenderer, Features, LiftMemory, Lifted, PixelValues};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::render::{
    project::{Splat, project},
    rasterize::{Rules, alpha, blend},
};

const CAMERAS: usize = 3;

fn cameras() -> Vec<Camera> {
    (0..CAMERAS)
        .map(|i| {
            let pose = Pose { translation: DVec3::new(0.2 * i as f64 - 0.2, 0.1, -0.3 * i as f64), ..Pose::IDENTITY };
            Camera { pose, ..camera(53, 41 - 3 * i as u32) }
        })
        .collect()
}

/// Returns the weights of all Gaussians at each pixel; `None` if rounding may decide a threshold.
fn weights(scene: &Scene, camera: &Camera) -> Vec<Option<Vec<f64>>> {
    let splats = project(&reference_gaussians(scene), &reference_camera(camera), scene.antialiased);
    let mut order: Vec<(usize, &Splat)> =
        splats.iter().enumerate().filter_map(|(i, splat)| splat.as_ref().map(|splat| (i, splat))).collect();
    order.sort_by(|a, b| (a.1.depth as f32).total_cmp(&(b.1.depth as f32)));
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let pixel = |i: u32| {
        let place = [f64::from(i % width) + 0.5, f64::from(i / width) + 0.5];
        let rules = Rules::default();
        let blended = blend(order.iter().map(|(_, splat)| *splat), place, rules);
        let mut left = 1.0;
        let mut weights = vec![0.0; scene.len()];
        for (n, splat) in &order {
            let alpha = alpha(splat, place, rules);
            if alpha < rules.min_alpha {
                continue;
            }
            if left * (1.0 - alpha) <= rules.min_transmittance {
                break;
            }
            weights[*n] = alpha * left;
            left *= 1.0 - alpha;
        }
        (!blended.unstable).then_some(weights)
    };
    (0..width * height).map(pixel).collect()
}

/// Cells of `scale` pixels, NaN if rounding may change them.
fn pictures(seen: &[Vec<Option<Vec<f64>>>], cameras: &[Camera], channels: usize, scale: u32) -> Vec<PixelValues> {
    let picture = |(i, camera): (usize, &Camera)| {
        let (width, height) = (camera.intrinsics.width / scale, camera.intrinsics.height / scale);
        let mut values = random(7 + i as u64, (width * height) as usize * channels);
        for (p, _) in seen[i].iter().enumerate().filter(|(_, weights)| weights.is_none()) {
            values[cell(p as u32, camera, [width, height]) * channels + p % channels] = f32::NAN;
        }
        PixelValues { width, height, channels, values }
    };
    cameras.iter().enumerate().map(picture).collect()
}

fn cell(pixel: u32, camera: &Camera, [width, height]: [u32; 2]) -> usize {
    let (columns, rows) = (camera.intrinsics.width, camera.intrinsics.height);
    (pixel / columns * height / rows * width + pixel % columns * width / columns) as usize
}

fn expected(
    seen: &[Vec<Option<Vec<f64>>>],
    cameras: &[Camera],
    pictures: &[PixelValues],
    rows: usize,
) -> (Vec<f64>, Vec<f64>) {
    let channels = pictures[0].channels;
    let (mut sums, mut totals) = (vec![0.0; rows * channels], vec![0.0; rows]);
    for ((pixels, camera), picture) in seen.iter().zip(cameras).zip(pictures) {
        for (p, weights) in pixels.iter().enumerate() {
            let at = cell(p as u32, camera, [picture.width, picture.height]) * channels;
            let values = &picture.values[at..at + channels];
            let Some(weights) = weights.as_ref().filter(|_| !values.iter().any(|value| value.is_nan())) else {
                continue;
            };
            let group = weights.len() / rows;
            for (n, weight) in weights.iter().enumerate().filter(|(_, weight)| **weight > 0.0) {
                totals[n / group] += weight;
                let row = &mut sums[n / group * channels..][..channels];
                row.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * f64::from(*value));
            }
        }
    }
    let mean = |(i, sum): (usize, &f64)| if totals[i / channels] > 0.0 { sum / totals[i / channels] } else { 0.0 };
    (sums.iter().enumerate().map(mean).collect(), totals)
}

fn lift(scene: &Scene, cameras: &[Camera], group: usize, pictures: &[PixelValues]) -> Lifted {
    let mut renderer = FeatureRenderer::new(device());
    renderer.lift(scene, cameras, group, pictures[0].channels, |i| Ok(pictures[i].clone())).expect("valid input")
}

#[test]
fn lifted_features_equal_brute_force() {
    let cameras = cameras();
    for (antialiased, group, channels, scale) in
        [(false, 1, 1, 1), (false, 1, 70, 1), (true, 1, 5, 1), (false, 4, 19, 5), (true, 8, 3, 2)]
    {
        let scene = Scene { antialiased, ..random_scene(400, 1, 0.3) };
        let seen: Vec<_> = cameras.iter().map(|camera| weights(&scene, camera)).collect();
        let pictures = pictures(&seen, &cameras, channels, scale);
        let (means, totals) = expected(&seen, &cameras, &pictures, scene.len() / group);
        let found = lift(&scene, &cameras, group, &pictures);
        assert!(totals.iter().filter(|total| **total > 0.0).count() > totals.len() / 3);
        for (i, (found, total)) in found.weights.iter().zip(&totals).enumerate() {
            assert!((f64::from(*found) - total).abs() <= 2e-4 * total + 1e-6, "weight of row {i}: {found}, {total}");
        }
        for (i, (found, mean)) in found.features.values.iter().zip(&means).enumerate() {
            let error = (f64::from(*found) - mean).abs();
            assert!(error < 3e-4, "feature {i} of {group} Gaussians, {channels} channels: {found}, {mean}");
        }
        assert_eq!(lift(&scene, &cameras, group, &pictures), found, "bits of a second run");
        assert_refused(found.select(&scene, &[3, 400], 0.5), &["seed", "400"]);
    }
}

#[test]
fn pictures_of_features_equal_brute_force() {
    let cameras = cameras();
    for (group, channels) in [(1, 1), (1, 37), (5, 16), (8, 3)] {
        let scene = random_scene(400, 0, 0.3);
        let values = random(3, scene.len() / group * channels);
        let features = Features { values, channels, group };
        let pictures = FeatureRenderer::new(device()).draw(&scene, &features, &cameras).expect("valid input");
        for (camera, picture) in cameras.iter().zip(&pictures) {
            assert_eq!([picture.width, picture.height], [camera.intrinsics.width, camera.intrinsics.height]);
            let drawn = weights(&scene, camera).into_iter().zip(picture.values.chunks_exact(channels));
            for (weights, found) in drawn.filter_map(|(weights, found)| Some((weights?, found))) {
                for (channel, found) in found.iter().enumerate() {
                    let value = |n: usize| f64::from(features.values[n / group * channels + channel]);
                    let truth: f64 = weights.iter().enumerate().map(|(n, weight)| weight * value(n)).sum();
                    assert!((f64::from(*found) - truth).abs() < 1e-4, "channel {channel}: {found}, {truth}");
                }
            }
        }
    }
}

#[test]
fn colors_are_drawn_as_features() {
    let scene = random_scene(3000, 0, 0.1);
    let camera = camera(130, 70);
    let color = |c: &[f32; 3]| c.map(|c| (0.5 + 0.282_094_8 * c).max(0.0));
    let features = Features { values: scene.sh_coeffs.iter().flat_map(color).collect(), channels: 3, group: 1 };
    let rgb = Renderer::new(device()).render_scene(&scene, &[camera], &RenderOptions::default()).unwrap();
    let drawn = FeatureRenderer::new(device()).draw(&scene, &features, &[camera]).unwrap();
    let rgb = rgb[0].rgb.as_ref().unwrap();
    assert!(drawn[0].values.iter().zip(rgb).all(|(a, b)| (a - b).abs() < 1e-5));
}

#[test]
fn invalid_features_name_themselves() {
    let (scene, camera) = (random_scene(12, 0, 0.3), camera(32, 32));
    let mut renderer = FeatureRenderer::new(device());
    let mut lift = |group: usize, channels: usize, values: PixelValues| {
        renderer.lift(&scene, &[camera], group, channels, |_| Ok(values.clone())).expect_err("invalid").to_string()
    };
    let values =
        |width: u32, channels: usize, len: usize| PixelValues { width, height: 2, channels, values: vec![0.0; len] };
    for (error, words) in [
        (lift(5, 1, values(2, 1, 4)), ["Gaussians per feature", "5", "12"]),
        (lift(0, 1, values(2, 1, 4)), ["Gaussians per feature", "0", "12"]),
        (lift(1, 0, values(2, 1, 4)), ["features", "0 channels", "12 rows"]),
        (lift(1, 2, values(2, 2, 7)), ["values of picture 0", "7", "2 channels"]),
        (lift(1, 2, values(2, 1, 4)), ["values of picture 0", "1 channels", "2 channels"]),
    ] {
        assert!(words.iter().all(|word| error.contains(word)), "{error}");
    }
    let features = Features { values: vec![0.0; 11], channels: 1, group: 1 };
    let error = renderer.draw(&scene, &features, &[camera]).expect_err("too few").to_string();
    assert!(error.contains("11 values") && error.contains("12 rows"), "{error}");
}

#[test]
fn many_channels_take_the_planned_memory() {
    let device = Device::open(&DeviceOptions::default()).unwrap();
    let (scene, cameras) = (random_scene(3_000, 0, 0.05), cameras());
    for (channels, is_one_part) in [(40, true), (1_200, false)] {
        let value = |i: usize| (i % channels) as f32;
        let picture = |_| {
            let values = (0..4 * channels).map(value).collect();
            Ok(PixelValues { width: 2, height: 2, channels, values })
        };
        let before = device.allocated_bytes();
        let mut renderer = FeatureRenderer::new(&device);
        let Lifted { features, weights } = renderer.lift(&scene, &cameras, 1, channels, picture).unwrap();
        let plan = LiftMemory::of(device.limits(), &scene, &cameras, 1, channels, [2, 2]).unwrap();
        let allocated = device.allocated_bytes() - before;
        assert!(allocated == plan.total() || !is_one_part && allocated < plan.total(), "{allocated}, {plan:?}");
        assert_eq!(plan.parts == 1, is_one_part, "{plan:?}");
        let seen = features.values.chunks_exact(channels).zip(&weights).filter(|(_, weight)| **weight > 0.0);
        let close = |(i, found): (usize, &f32)| (found - value(i)).abs() <= 1e-5 * value(i).max(1.0);
        let count = seen.inspect(|(row, _)| assert!(row.iter().enumerate().all(close), "{:?}", &row[..8])).count();
        assert!(count > 100, "{count}");
    }
}

fn open(max_binding_bytes: u64) -> Device {
    let options = DeviceOptions { max_binding_bytes: Some(max_binding_bytes), ..DeviceOptions::default() };
    Device::open(&options).unwrap()
}

#[test]
fn lifting_takes_the_planned_memory_in_small_bindings() {
    let scene = random_scene(400, 0, 0.05);
    // Cells and intersections beyond a binding, then a pixel's channels.
    for (max_binding_bytes, side, cells, channels, parts) in [(200 << 10, 60, 480, 1, 1), (4 << 20, 320, 320, 12, 3)] {
        let (device, camera) = (open(max_binding_bytes), camera(side, side));
        let values = random(5, (cells * cells) as usize * channels);
        let picture = PixelValues { width: cells, height: cells, channels, values };
        let plan = LiftMemory::of(device.limits(), &scene, &[camera], 1, channels, [cells; 2]).unwrap();
        let before = device.allocated_bytes();
        let mut renderer = FeatureRenderer::new(&device);
        let found = renderer.lift(&scene, &[camera], 1, channels, |_| Ok(picture.clone())).unwrap();
        assert_eq!((plan.parts, plan.total()), (parts, device.allocated_bytes() - before), "{plan:?}");
        let at = |pixel: u32| picture.values[cell(pixel, &camera, [cells; 2]) * channels..][..channels].to_vec();
        let values = (0..side * side).flat_map(at).collect();
        let of_pixels = PixelValues { width: side, height: side, channels, values };
        assert!(found.weights.iter().any(|weight| *weight > 0.0));
        assert_eq!(found, lift(&scene, &[camera], 1, &[of_pixels]));
    }
}

#[test]
fn pictures_beyond_a_binding_are_drawn_in_bands() {
    let (scene, camera) = (random_scene(2_000, 0, 0.1), camera(130, 200));
    let features = Features { values: random(3, 2_000 * 5), channels: 5, group: 1 };
    let draw = |device: &Device| FeatureRenderer::new(device).draw(&scene, &features, &[camera]).unwrap();
    // Rows of 8,320 bytes: bands of 48 rows.
    assert_eq!(draw(&open(512 << 10)), draw(device()));
}
