use std::collections::HashMap;

use zipsplat_cli::procedural::{Family, PathKind, Shape};

use crate::{capture, options, setup};

#[test]
fn every_family_path_and_shape_appears() {
    let (mut families, mut paths, mut shapes) = (HashMap::new(), HashMap::new(), HashMap::new());
    for seed in 0..200 {
        let setup = setup(seed, &options(6, 32));
        *families.entry(setup.family).or_insert(0) += 1;
        *paths.entry(setup.path).or_insert(0) += 1;
        let count = setup.world.primitives().len();
        assert!((5..=60).contains(&count), "seed {seed} ({}): {count} primitives", setup.family);
        for primitive in setup.world.primitives() {
            *shapes.entry(std::mem::discriminant(&primitive.shape)).or_insert(0) += 1;
        }
    }
    for family in Family::ALL {
        assert!(families.get(&family).is_some_and(|count| *count >= 20), "{families:?}");
    }
    for path in PathKind::ALL {
        assert!(paths.get(&path).is_some_and(|count| *count >= 10), "{paths:?}");
    }
    assert!(shapes.len() == 6 && shapes.values().all(|count| *count >= 20), "{:?}", shapes.values());
}

#[test]
fn thin_rods_appear() {
    let is_rod = |shape: &Shape| matches!(shape, Shape::Cylinder { radius, half_height } if half_height / radius > 8.0);
    let count = |seed| setup(seed, &options(4, 32)).world.primitives().iter().filter(|p| is_rod(&p.shape)).count();
    assert!((0..40).map(count).sum::<usize>() > 40);
}

#[test]
fn numbers_are_finite_and_pictures_neither_dark_nor_white() {
    let mut angles = Vec::new();
    for seed in 0..60 {
        let capture = capture(seed, &options(4, 32));
        for (view, camera) in capture.cameras.iter().enumerate() {
            camera.validate("camera").expect("a camera that can be used");
            let [width, height] = [camera.intrinsics.hfov(), camera.intrinsics.vfov()].map(f64::to_degrees);
            angles.push(width.max(height));
            let depth = &capture.depths[view];
            assert!(depth.iter().all(|z| z.is_finite() && *z >= 0.0), "seed {seed}, view {view}");
            let surface = depth.iter().filter(|z| **z > 0.0).count() as f32 / depth.len() as f32;
            assert!(surface > 0.4, "seed {seed}, view {view}: {surface} of it are surfaces");
            let rgb = &capture.images[view].rgb;
            let mean = rgb.iter().map(|value| f64::from(*value)).sum::<f64>() / rgb.len() as f64;
            assert!((30.0..225.0).contains(&mean), "seed {seed}, view {view}: mean {mean}");
        }
        assert!(capture.overlap.iter().all(|share| (0.0..=1.0).contains(share)));
    }
    let (low, high) = angles.iter().fold((f64::MAX, 0f64), |(low, high), angle| (low.min(*angle), high.max(*angle)));
    assert!(low >= 27.99 && high <= 92.01 && low < 35.0 && high > 80.0, "fields of view from {low} to {high}");
}
