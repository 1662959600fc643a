//! Cases too slow for `zipsplat doctor`.

use crate::below;
use zipsplat_tests::prelude::*;

fn alpha() -> RenderOptions {
    RenderOptions { alpha: true, ..RenderOptions::default() }
}

fn draw(scene: &Scene, camera: Camera, request: &RenderOptions) -> RenderOutput {
    let frame = Renderer::new(device()).render_scene(scene, &[camera], request).unwrap().remove(0);
    let planes = [&frame.rgb, &frame.alpha, &frame.depth].into_iter().flatten();
    assert!(planes.flatten().all(|value| value.is_finite()), "a pixel that is no number");
    frame
}

/// Coincident, isotropic, gray.
fn pile(count: usize, opacity: f32, sigma: f32) -> Scene {
    Scene {
        means: vec![[0.0, 0.0, 2.0]; count],
        scales: vec![[sigma; 3]; count],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacities: vec![opacity; count],
        sh_coeffs: vec![[0.5; 3]; count],
        ..Scene::default()
    }
}

/// Until transmittance would reach 1e-4.
fn stacked(count: usize, alpha: f64) -> f64 {
    let mut left = 1.0;
    for _ in 0..count {
        if left * (1.0 - alpha) <= 1e-4 {
            break;
        }
        left *= 1.0 - alpha;
    }
    1.0 - left
}

#[test]
fn a_million_gaussians_on_one_pixel() {
    let count = 1_000_000;
    for opacity in [0.0041f32, 0.5, 1.0] {
        let frame = draw(&pile(count, opacity, 1e-4), camera(1, 1), &alpha());
        let truth = stacked(count, f64::from(opacity.min(0.999)));
        let got = f64::from(frame.alpha.unwrap()[0]);
        // 2,300 layers round a few times each.
        assert!((got - truth).abs() < 1e-4 * 2e-2 + 1e-6, "opacity {opacity}: {got}, truth {truth}");
    }
}

#[test]
fn one_gaussian_over_every_tile_of_a_large_picture() {
    let frame = draw(&pile(1, 1.0, 1e3), camera(2048, 1024), &alpha());
    let alpha = frame.alpha.unwrap();
    assert!(alpha.iter().all(|a| (a - 0.999).abs() < 1e-4), "{:?}", alpha.iter().fold(1.0f32, |l, a| l.min(*a)));
}

#[test]
fn scenes_that_no_camera_sees() {
    let behind = |z: f32| Scene { means: vec![[0.0, 0.0, z]; 1000], ..pile(1000, 1.0, 0.5) };
    for z in [-2.0, 0.0, 0.0099, 1.1e10, f32::MAX] {
        let frame = draw(&behind(z), camera(33, 17), &alpha());
        assert!(frame.alpha.unwrap().iter().all(|a| *a == 0.0), "at {z}");
    }
    let faint = draw(&pile(10_000, 0.0039, 0.5), camera(33, 17), &alpha());
    assert!(faint.alpha.unwrap().iter().all(|a| *a == 0.0), "below 1/255");
}

#[test]
fn absurd_but_finite_values_spread_no_nan() {
    let extremes = [0.0f32, -0.0, 1e-45, 1e-38, 1e-20, 1e20, 1e38, f32::MAX];
    let mut random = Random::new(1);
    for round in 0..20 {
        let mut scene = random_scene(400, round % 4, 0.1);
        let coeffs = scene.sh_coeffs_per_gaussian();
        let mut pick = |sign: bool| {
            let value = extremes[below(&mut random, extremes.len())];
            if sign && below(&mut random, 2) == 1 { -value } else { value }
        };
        for i in (0..400).step_by(3) {
            match i % 4 {
                0 => scene.means[i] = [pick(true), pick(true), pick(true)],
                1 => scene.scales[i] = [pick(false), pick(false), pick(false)],
                2 => scene.quats[i] = [pick(true), pick(true), pick(true), 1e-30],
                _ => scene.sh_coeffs[i * coeffs] = [0.9, pick(true).clamp(-1e20, 1e20), 0.1],
            }
        }
        let request = RenderOptions { depth: Some(Depth::Accumulated), antialiased: Some(round % 2 == 1), ..alpha() };
        let frame = draw(&scene, camera(64, 48), &request);
        assert!(frame.alpha.unwrap().iter().any(|a| *a > 0.1), "round {round}: the others are still drawn");
    }
}
