//! Pose search, against ZipSplat's authors.

use zipsplat::{gpu::Arena, perceptual::Perceptual, stages::lpips::LpipsNetwork};
use zipsplat_cli::align::adam::Descent;
use zipsplat_tests::prelude::*;
use zipsplat_tests::{golden::lpips_weights, scenes::intrinsics};

/// The golden's loss is the mean of both photos.
fn check_steps(golden: &Golden, below: &str, mut lpips: Option<Perceptual>, steps: usize) {
    let mut renderer = Renderer::new(device());
    renderer.set_scene(&golden_scene(golden)).unwrap();
    let (starts, targets) = (golden.f64("init_c2w"), golden.f32("target"));
    let arena = Arena::new(device());
    let pixels = targets.len() / 2;
    let descent = |(i, lens)| {
        let camera = Camera { intrinsics: lens, pose: scenes::pose(&starts[12 * i..][..12]) };
        Descent::new(&renderer, &arena, &targets[i * pixels..][..pixels], &camera).unwrap()
    };
    let mut descents: Vec<Descent> = intrinsics(golden).into_iter().enumerate().map(descent).collect();
    if lpips.is_none() {
        let gradients = descents.iter_mut().flat_map(|descent| descent.gradient(&mut renderer, None).unwrap().1);
        let d_delta: Vec<f64> = gradients.map(|g| g / 2.0).collect();
        assert_close("d_delta", &d_delta, &golden.f64("step0/d_delta"), Tolerance::rms(3e-5));
    }
    let (losses, poses) = (golden.f64(&format!("{below}loss")), golden.f64(&format!("{below}poses")));
    for (step, truth) in losses.iter().take(steps).enumerate() {
        let mut of_step = |descent: &mut Descent| descent.step(&mut renderer, lpips.as_mut()).unwrap();
        let loss = descents.iter_mut().map(&mut of_step).sum::<f64>() / 2.0;
        assert!((loss - truth).abs() <= 1e-2 * truth, "loss {step} is {loss}, truth {truth}");
        let found = scenes::pose_rows(descents.iter().map(|descent| &descent.camera.pose));
        let error = if step == 0 { 1e-6 } else { 1e-3 };
        let truth = &poses[24 * (step + 1)..][..24];
        let worst = found.iter().zip(truth).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(worst <= error, "poses after step {step} are {worst:.1e} off");
    }
}

#[test]
fn the_steps_are_those_of_the_authors() {
    for golden in golden::list("grad_pose").into_iter().filter_map(|file| Golden::open(&file)) {
        check_steps(&golden, "", None, 30);
    }
}

#[test]
fn the_steps_with_lpips_are_those_of_the_authors() {
    let Some(path) = lpips_weights(LpipsNetwork::Vgg) else { return };
    for golden in golden::list("grad_pose").into_iter().filter_map(|file| Golden::open(&file)) {
        let lpips = Perceptual::open(device(), LpipsNetwork::Vgg, &path, true).unwrap();
        check_steps(&golden, "lpips/", Some(lpips), 6);
    }
}
