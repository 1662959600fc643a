//! Scenes and cameras at f32's limits: drawn correctly or rejected by name.

use crate::render::{ALL, bits, render};
use glam::DVec2;
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::render::rasterize;

/// Compares color and alpha with brute force in f64.
#[track_caller]
fn hold(what: &str, scene: &Scene, camera: &Camera, antialiased: bool, tolerance: ImageTolerance) {
    let frame = render(scene, &[*camera], &RenderOptions { antialiased: Some(antialiased), ..ALL }).remove(0);
    let truth = rasterize::render(&reference_gaussians(scene), &reference_camera(camera), antialiased, [0.0; 3]);
    let width = frame.width as usize;
    for (plane, channels, values, truth_values) in
        [("rgb", 3, frame.rgb.unwrap(), &truth.rgb), ("alpha", 1, frame.alpha.unwrap(), &truth.alpha)]
    {
        let picture = Picture { values: &values, width, channels };
        assert_images_close(&format!("{what} {plane}"), picture, truth_values, &truth.unstable, tolerance);
    }
    let seen = truth.alpha.iter().filter(|alpha| **alpha > 0.02).count();
    assert!(8 * seen > truth.alpha.len(), "{what}: little to see, {seen} pixels");
}

fn turned() -> Camera {
    let mut turned = camera(70, 53);
    (turned.intrinsics.fx, turned.intrinsics.fy) = (70.3, 68.9);
    turned.pose = Pose {
        rotation: DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.3),
        translation: DVec3::new(0.125, -0.25, -0.5),
    };
    turned
}

/// Rounds means to f32 there.
fn moved(scene: &Scene, camera: Camera, offset: DVec3) -> (Scene, Camera) {
    let mean = |mean: &[f32; 3]| (DVec3::from(mean.map(f64::from)) + offset).as_vec3().to_array();
    let pose = Pose { translation: camera.pose.translation + offset, ..camera.pose };
    (Scene { means: scene.means.iter().map(mean).collect(), ..scene.clone() }, Camera { pose, ..camera })
}

#[test]
fn pictures_far_from_the_origin_equal_brute_force() {
    let scene = random_scene(300, 2, 0.3);
    for distance in [1e4, 1e5, 1e6, 1e7] {
        let offset = distance * DVec3::new(1.0 / 3.0, -0.1, 1.0 / 7.0);
        let (scene, camera) = moved(&scene, turned(), offset);
        hold(&format!("{distance:e} away"), &scene, &camera, false, ImageTolerance::RGB);
    }
}

#[test]
fn a_scene_that_moves_with_its_camera_is_the_same_picture() {
    let mut scene = random_scene(500, 2, 0.3);
    // Multiples of 1/8, exact in f32 up to 2e6.
    scene.means.iter_mut().flatten().for_each(|x| *x = (8.0 * *x).round() / 8.0);
    let expected = bits(&render(&scene, &[turned()], &ALL));
    for offset in [[1e4, 2e4, -1e4], [-1e5, 1e5, 3e5], [1e6, -1e6, 1e6]] {
        let (scene, camera) = moved(&scene, turned(), offset.into());
        assert_eq!(bits(&render(&scene, &[camera], &ALL)), expected, "moved by {offset:?}");
    }
}

/// Centered `distance` pixels off the picture, in all directions.
fn needles(camera: &Camera, count: usize, distance: f64) -> Scene {
    let mut scene = random_scene(count, 0, 0.1);
    let i = &camera.intrinsics;
    let (size, focal) = (DVec2::new(i.width.into(), i.height.into()), DVec2::new(i.fx, i.fy));
    for n in 0..count {
        let turn = n as f64 / count as f64;
        let (along, depth) = (DVec2::from_angle(7.3 * turn * std::f64::consts::TAU), 1.0 + turn);
        let seen = size * DVec2::new((5.7 * turn).fract(), (3.1 * turn).fract());
        let slope = (seen + distance * along - DVec2::new(i.cx, i.cy)) / focal;
        // Projected from within 15 % of the picture.
        let clamped = slope.clamp(-0.65 * size / focal, 0.65 * size / focal);
        let towards = 0.4 * (n % 3) as f64 - 0.4;
        let axis = (along / focal + towards * clamped).extend(towards);
        let rotation = DQuat::from_mat3(&camera.pose.rotation) * DQuat::from_rotation_arc(DVec3::X, axis.normalize());
        let [x, y, z, w] = (rotation * DQuat::from_rotation_x(turn)).as_quat().to_array();
        scene.means[n] = camera.pose.transform((depth * slope).extend(depth)).as_vec3().to_array();
        scene.scales[n] = [(axis.length() * distance * depth) as f32, 1e-3, 2e-3];
        scene.quats[n] = [w, x, y, z];
        scene.opacities[n] = 0.9;
    }
    scene
}

#[test]
fn needles_far_off_the_picture_equal_brute_force() {
    for distance in [1e3, 1e4, 1e5] {
        let scene = needles(&turned(), 60, distance);
        hold(&format!("{distance:e} pixels off"), &scene, &turned(), false, ImageTolerance::RGB_EDGE);
    }
}

#[test]
fn rotations_of_any_length_are_drawn_as_what_they_are() {
    for length in [1e-44, 1e-41, 1e-38, 1e-30, 1e30, 3e38] {
        let mut scene = random_scene(200, 1, 0.3);
        scene.quats.iter_mut().flatten().for_each(|q| *q *= length);
        // Of the remaining length one component is exact.
        hold(&format!("rotations of length {length:e}"), &scene, &turned(), false, ImageTolerance::RGB);
    }
}

#[test]
fn gaussians_of_any_size_are_drawn() {
    for scales in [[3e8; 3], [1e9, 2e9, 1e9], [1e12, 1e12, 1e-3], [1e10, 1e-3, 2e-3], [1e30; 3], [f32::MAX; 3]] {
        for antialiased in [false, true] {
            let mut scene = random_scene(3, 1, 0.1);
            scene.scales.fill(scales);
            scene.opacities.fill(0.6);
            let what = format!("scales of {scales:?}, antialiased {antialiased}");
            let tolerance = ImageTolerance::RGB_EDGE;
            let options = RenderOptions { antialiased: Some(antialiased), ..ALL };
            let frame = render(&scene, &[turned()], &options).remove(0);
            assert!(frame.alpha.unwrap().iter().any(|alpha| *alpha > 0.01), "{what}: nothing is drawn");
            let truth =
                rasterize::render(&reference_gaussians(&scene), &reference_camera(&turned()), antialiased, [0.0; 3]);
            let picture = Picture { values: &frame.rgb.unwrap(), width: 70, channels: 3 };
            assert_images_close(&what, picture, &truth.rgb, &truth.unstable, tolerance);
        }
    }
}

#[test]
fn cameras_beyond_f32_are_refused() {
    let mut renderer = Renderer::new(device());
    renderer.set_scene(&random_scene(10, 0, 0.1)).unwrap();
    type Change = fn(&mut Camera, f64);
    let changes: [(&str, f64, Change); 6] = [
        ("fx", 1e-40, |camera, value| camera.intrinsics.fx = value),
        ("fy", 1e39, |camera, value| camera.intrinsics.fy = value),
        ("cx", -1e39, |camera, value| camera.intrinsics.cx = value),
        ("cy", 1e39, |camera, value| camera.intrinsics.cy = value),
        ("translation x", 1e39, |camera, value| camera.pose.translation.x = value),
        ("translation z", -1e39, |camera, value| camera.pose.translation.z = value),
    ];
    for (field, value, change) in changes {
        let mut camera = turned();
        change(&mut camera, value);
        let error = renderer.render(&[turned(), camera], &ALL).expect_err(field).to_string();
        assert!(error.starts_with(&format!("camera 1, {field}: found {value:e}, expected ")), "{error}");
    }
}
