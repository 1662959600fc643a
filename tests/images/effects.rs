//! Optional outputs and effects: correct on request, free otherwise.

use crate::render::{ALL, render};
use std::num::NonZeroU32;
use zipsplat::gpu::{Plan, Profile};
use zipsplat::stages::render::{CameraRows, FrameInputs, FrameShape};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::render::{normals, project, rasterize};

const SIZE: [usize; 2] = [70, 53];

/// Also returns pixels that rounding decides.
fn blended(scene: &Scene, camera: &Camera, value: impl Fn(usize) -> [f64; 3]) -> (Vec<f64>, Vec<u8>) {
    let mut splats = project::project(&reference_gaussians(scene), &reference_camera(camera), false);
    for (i, splat) in splats.iter_mut().enumerate() {
        splat.iter_mut().for_each(|splat| splat.color = value(i));
    }
    let rendering = rasterize::rasterize(&splats, SIZE, [0.0; 3]);
    (rendering.rgb, rendering.unstable)
}

fn hold(what: &str, values: &[f32], truth: &[f64], unstable: &[u8], tolerance: ImageTolerance) {
    let picture = Picture { values, width: SIZE[0], channels: 3 };
    assert_images_close(what, picture, truth, unstable, tolerance);
}

#[test]
fn normals_are_blended_and_of_length_one() {
    let (scene, camera) = (random_scene(300, 0, 0.3), camera(SIZE[0] as u32, SIZE[1] as u32));
    let frame = render(&scene, &[camera], &RenderOptions { normals: true, ..RenderOptions::default() }).remove(0);
    let (gaussians, reference) = (reference_gaussians(&scene), reference_camera(&camera));
    let (mut truth, mut unstable) = blended(&scene, &camera, |i| normals::normal(&gaussians, i, &reference));
    let got = frame.normals.unwrap();
    for ((normal, got), unstable) in truth.chunks_exact_mut(3).zip(got.chunks_exact(3)).zip(&mut unstable) {
        let length = normal.iter().map(|v| v * v).sum::<f64>().sqrt();
        normal.iter_mut().for_each(|v| *v /= length.max(1e-10));
        // Canceling normals amplify rounding.
        *unstable |= u8::from(length > 0.0 && length < 0.05);
        let unit = got.iter().map(|v| v * v).sum::<f32>().sqrt();
        assert!(if length == 0.0 { unit == 0.0 } else { (unit - 1.0).abs() < 1e-5 || *unstable != 0 }, "{got:?}");
    }
    hold("normals", &got, &truth, &unstable, ImageTolerance { absolute: 2e-4, psnr: 90.0, ..ImageTolerance::RGB });
}

#[test]
fn tokens_have_colors_of_their_own() {
    // PCG by its 64-bit definition.
    let color = |token: usize| {
        let state = (token as u64 * 747_796_405 + 2_891_336_453) % (1 << 32);
        let word = ((state >> ((state >> 28) + 4)) ^ state) * 277_803_737 % (1 << 32);
        let hash = word >> 22 ^ word;
        [0, 8, 16].map(|shift| (hash >> shift & 255) as f64 / 255.0)
    };
    assert_ne!(color(0), color(1));
    let camera = camera(SIZE[0] as u32, SIZE[1] as u32);
    let scene = random_scene(300, 0, 0.3);
    for group in [1, 32, u32::MAX] {
        let request = RenderOptions { token_group: NonZeroU32::new(group), ..RenderOptions::default() };
        let frames = render(&scene, &[camera, camera], &request);
        let (truth, unstable) = blended(&scene, &camera, |i| color(i / group as usize));
        for frame in frames {
            hold("tokens", &frame.token_colors.unwrap(), &truth, &unstable, ImageTolerance::RGB);
        }
    }
}

#[test]
fn what_is_not_asked_for_changes_nothing() {
    let (scene, cameras) = (random_scene(2_000, 1, 0.1), [camera(100, 60)]);
    let all = render(&scene, &cameras, &ALL).remove(0);
    for wanted in 1..32 {
        let on = |output: u32| wanted >> output & 1 == 1;
        let request = RenderOptions {
            rgb: on(0),
            alpha: on(1),
            depth: ALL.depth.filter(|_| on(2)),
            normals: on(3),
            token_group: ALL.token_group.filter(|_| on(4)),
            ..ALL
        };
        let expected = RenderOutput {
            rgb: all.rgb.clone().filter(|_| on(0)),
            alpha: all.alpha.clone().filter(|_| on(1)),
            depth: all.depth.clone().filter(|_| on(2)),
            normals: all.normals.clone().filter(|_| on(3)),
            token_colors: all.token_colors.clone().filter(|_| on(4)),
            ..all
        };
        assert_eq!(render(&scene, &cameras, &request), [expected], "{request:?}");
    }
}

fn plan(request: &RenderOptions) -> Plan {
    let mut rec = Recorder::new(&Limits::default());
    let scene = scenes::scene_inputs(&mut rec, 5_000, 1);
    let cameras = rec.input::<CameraRows>("cameras", 1);
    let shape = FrameShape { cameras: 1, width: 64, height: 64 };
    FrameInputs { scene: &scene, cameras, shape, options: request, capacity: 1 << 14 }.record(&mut rec);
    rec.finish().unwrap()
}

fn contents(plan: &Plan) -> (Vec<String>, Vec<(String, u64)>) {
    let kernels = Profile::outline(plan).rows.into_iter().map(|row| row.kernel).collect();
    let mut tensors: Vec<_> = plan.arena_map().into_iter().map(|row| (row.name, row.bytes)).collect();
    tensors.sort();
    (kernels, tensors)
}

#[test]
fn what_is_not_asked_for_costs_nothing() {
    let color = RenderOptions::default();
    let (kernels, tensors) = contents(&plan(&color));
    let has = |tensors: &[(String, u64)], name: &str| tensors.iter().any(|(other, _)| other.ends_with(name));
    assert!(has(&tensors, "/colors") && !has(&tensors, "/normals"), "{tensors:?}");

    let (with_normals, its_tensors) = contents(&plan(&RenderOptions { normals: true, ..color }));
    assert!(has(&its_tensors, "/normals") && with_normals.len() == kernels.len() + 1);
    assert!(with_normals.contains(&"render/normals".into()) && !kernels.contains(&"render/normals".into()));
    let (_, alone) = contents(&plan(&RenderOptions { rgb: false, alpha: true, ..color }));
    assert!(!has(&alone, "/colors"), "{alone:?}");

    let specialized = [
        RenderOptions { alpha: true, ..color },
        RenderOptions { depth: Some(Depth::Expected), ..color },
        RenderOptions { token_group: NonZeroU32::new(4), ..color },
        RenderOptions { background: [1.0; 3], ..color },
        RenderOptions { antialiased: Some(true), ..color },
    ];
    for request in specialized {
        let (its_kernels, mut its_tensors) = contents(&plan(&request));
        let frames = its_tensors.iter_mut().find(|(name, _)| name.ends_with("/frames")).unwrap();
        assert_eq!(frames.1, 4 * 64 * 64 * request.channels() as u64);
        frames.1 = 4 * 64 * 64 * color.channels() as u64;
        assert_eq!((its_kernels, its_tensors), (kernels.clone(), tensors.clone()), "{request:?}");
    }
}

#[test]
fn bands_of_zeros_are_neither_stored_nor_drawn() {
    let (low, camera) = (random_scene(500, 1, 0.2), camera(40, 30));
    let mut high = Scene { sh_degree: 3, sh_coeffs: Vec::new(), ..low.clone() };
    for coeffs in low.sh_coeffs.chunks_exact(4) {
        high.sh_coeffs.extend(coeffs);
        high.sh_coeffs.extend([[0.0; 3]; 12]);
    }
    assert_eq!(render(&high, &[camera], &ALL), render(&low, &[camera], &ALL));
    let mut renderer = Renderer::new(device());
    renderer.set_scene(&high).unwrap();
    let why = |renderer: &Renderer, what: &str| {
        renderer.skipped_passes(&ALL).into_iter().find(|left| left.what == what).map(|left| left.why)
    };
    assert_eq!(why(&renderer, "spherical harmonics of band 1"), None);
    assert_eq!(why(&renderer, "spherical harmonics of band 2").as_deref(), Some("all zero in this scene"));
    renderer.set_scene(&low).unwrap();
    assert_eq!(why(&renderer, "spherical harmonics of band 2").as_deref(), Some("not in this scene"));
    assert_eq!(why(&renderer, "normals"), None);
}

#[test]
fn antialiased_scenes_are_drawn_as_such_unless_options_differ() {
    let (plain, camera) = (random_scene(300, 1, 0.01), camera(40, 30));
    let tagged = Scene { antialiased: true, ..plain.clone() };
    let draw = |scene: &Scene, antialiased: Option<bool>| {
        render(scene, &[camera], &RenderOptions { antialiased, ..RenderOptions::default() }).remove(0)
    };
    let [on, off] = [true, false].map(|antialiased| draw(&plain, Some(antialiased)));
    assert_ne!(on, off);
    assert_eq!((draw(&plain, None), draw(&tagged, None)), (off.clone(), on));
    assert_eq!(draw(&tagged, Some(false)), off);
    // Memory and plans of an equally large scene are kept.
    let mut renderer = Renderer::new(device());
    let mut next =
        |scene: &Scene| renderer.render_scene(scene, &[camera], &RenderOptions::default()).unwrap().remove(0);
    let frames = [next(&plain), next(&tagged), next(&plain)];
    assert_eq!(frames, [draw(&plain, None), draw(&tagged, None), off]);
    assert!(renderer.scene().unwrap().read().unwrap() == plain);
    renderer.set_scene(&tagged).unwrap();
    assert!(renderer.scene().unwrap().read().unwrap().antialiased);
}
