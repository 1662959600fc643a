use crate::render::{ALL, bits, render};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::render::rasterize;

fn cases() -> impl Iterator<Item = (Scene, Camera)> {
    let poses = [(0.0, 0.0, 0.0), (0.3, 0.1, -0.2), (-0.5, -0.2, 0.4), (0.1, 2.9, 4.0)];
    let sizes = [(0.02, 90, 61), (0.1, 64, 64), (0.5, 33, 100), (3.0, 128, 17)];
    sizes.into_iter().zip(poses).enumerate().map(|(i, ((size, width, height), (x, turn, z)))| {
        let pose = Pose { rotation: DMat3::from_rotation_y(turn), translation: DVec3::new(x, 0.1 * x, z) };
        (random_scene(1_500 + 100 * i, i as u32, size), Camera { pose, ..camera(width, height) })
    })
}

#[test]
fn the_order_of_gaussians_changes_nothing() {
    for (scene, camera) in cases() {
        let stride = scene.sh_coeffs_per_gaussian();
        for step in [1_237, 7] {
            let mut shuffled = Scene { sh_degree: scene.sh_degree, ..Scene::default() };
            for i in (0..scene.len()).map(|i| i * step % scene.len()) {
                shuffled.means.push(scene.means[i]);
                shuffled.scales.push(scene.scales[i]);
                shuffled.quats.push(scene.quats[i]);
                shuffled.opacities.push(scene.opacities[i]);
                shuffled.sh_coeffs.extend_from_slice(&scene.sh_coeffs[stride * i..][..stride]);
            }
            // Distinct depths: ties are broken by index.
            let request = RenderOptions { token_group: None, ..ALL };
            assert_eq!(bits(&render(&scene, &[camera], &request)), bits(&render(&shuffled, &[camera], &request)));
        }
    }
}

#[test]
fn the_scale_of_the_world_cancels() {
    for (mut scene, camera) in cases() {
        // The near plane does not scale.
        let depth = |mean: &[f32; 3]| camera.view_matrix().transform_point3(DVec3::from(mean.map(f64::from))).z;
        for (opacity, mean) in scene.opacities.iter_mut().zip(&scene.means) {
            if (0.0..0.05).contains(&depth(mean)) {
                *opacity = 0.0;
            }
        }
        let frame = render(&scene, &[camera], &ALL).remove(0);
        // Powers of two are exact.
        for scale in [0.25f32, 4.0, 1024.0] {
            let mut other = scene.clone();
            other.scale(scale);
            let mut there = camera;
            there.pose.translation *= f64::from(scale);
            let got = render(&other, &[there], &ALL).remove(0);
            let depth: Vec<f32> = frame.depth.as_ref().unwrap().iter().map(|z| scale * z).collect();
            assert_eq!(got.depth.as_ref(), Some(&depth), "scale {scale}");
            assert_eq!(
                (&got.rgb, &got.alpha, &got.normals),
                (&frame.rgb, &frame.alpha, &frame.normals),
                "scale {scale}"
            );
        }
    }
}

#[test]
fn tiny_worlds_are_drawn() {
    let (scene, camera) = (random_scene(1_500, 0, 0.1), camera(64, 64));
    let frame = render(&scene, &[camera], &RenderOptions::default()).remove(0);
    let mut tiny = scene.clone();
    tiny.scale(2.0f32.powi(-14));
    let drawn = render(&tiny, &[camera], &RenderOptions::default()).remove(0);
    assert_eq!(drawn.rgb, frame.rgb);
    let fixed = RenderOptions { near: Some(0.01), ..RenderOptions::default() };
    let culled = render(&tiny, &[camera], &fixed).remove(0);
    assert!(culled.rgb.is_some_and(|rgb| rgb.iter().all(|value| *value == 0.0)));
}

#[test]
fn the_world_of_a_scene_does_not_show() {
    let (scene, camera) = (random_scene(800, 3, 0.15), camera(64, 48));
    let turn = DMat3::from_rotation_z(2.4) * DMat3::from_rotation_x(-1.1) * DMat3::from_rotation_y(0.7);
    let pose = Pose { rotation: turn, translation: DVec3::new(3.0, -2.0, 5.0) };
    let mut placed = scene.clone();
    placed.place(2.0, &pose);
    let request = RenderOptions { depth: None, normals: false, ..ALL };
    let truth = render(&scene, &[camera], &request).remove(0).rgb.unwrap();
    let drawn = render(&placed, &[Camera { pose, ..camera }], &request).remove(0).rgb.unwrap();
    let unstable =
        rasterize::render(&reference_gaussians(&scene), &reference_camera(&camera), false, [0.0; 3]).unstable;
    let picture = Picture { values: &drawn, width: 64, channels: 3 };
    let tolerance = ImageTolerance { absolute: 1e-3, psnr: 60.0, ..ImageTolerance::RGB };
    assert_images_close("placed", picture, &truth, &unstable, tolerance);
}

#[test]
fn alpha_is_the_sum_of_weights_within_bounds() {
    for (mut scene, camera) in cases() {
        // White in every direction: 0.5 + 0.28209479 c = 1.
        let stride = scene.sh_coeffs_per_gaussian();
        for coeffs in scene.sh_coeffs.chunks_exact_mut(stride) {
            coeffs.fill([0.0; 3]);
            coeffs[0] = [1.772_453_9; 3];
        }
        for opaque in [false, true] {
            if opaque {
                scene.opacities.fill(1.0);
            }
            let frame = render(&scene, &[camera], &ALL).remove(0);
            let (rgb, alpha) = (frame.rgb.unwrap(), frame.alpha.unwrap());
            assert!(alpha.iter().any(|a| *a > 0.1), "something is seen");
            for (rgb, alpha) in rgb.chunks_exact(3).zip(&alpha) {
                assert!((0.0..=1.0).contains(alpha), "alpha {alpha}");
                assert!(rgb.iter().all(|weights| (weights - alpha).abs() < 2e-5), "{rgb:?}, alpha {alpha}");
            }
        }
    }
}
