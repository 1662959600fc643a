use crate::calls::*;
use std::ptr::{null, null_mut};
use zipsplat::{
    stages::render::{CAMERA_NUMBERS, Depth, Differentiator, RenderOptions, RenderOutput, Wanted},
    types::{Camera, Intrinsics, Pose, Scene},
};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{compare::assert_same, device::device as rust_device, scenes::random_scene};

const SIZE: [u32; 2] = [40, 30];
const PIXELS: usize = (SIZE[0] * SIZE[1]) as usize;

struct Case {
    scene: Scene,
    cameras: [zs_camera; 2],
    weights: [Vec<f32>; 3],
    found: [Vec<f32>; 7],
}

impl Case {
    fn new() -> Self {
        let scene = random_scene(40, 1, 0.3);
        let wave = |width: usize| (0..2 * width * PIXELS).map(|i| (0.003 * i as f32).sin()).collect();
        let n = scene.len();
        let found = [3 * n, 3 * n, 4 * n, n, 12 * n, 2 * CAMERA_NUMBERS, 4 * n].map(|len| vec![7.0; len]);
        Self {
            cameras: [-0.2, 0.3].map(|right| camera(SIZE[0], SIZE[1], right)),
            weights: [3, 1, 1].map(wave),
            found,
            scene,
        }
    }

    fn pictures(values: &mut [Vec<f32>; 3]) -> [zs_render_buffers; 2] {
        let [rgb, alpha, depth] = values;
        [0, 1].map(|i| zs_render_buffers {
            alpha: alpha[i * PIXELS..].as_mut_ptr(),
            depth: depth[i * PIXELS..].as_mut_ptr(),
            ..picture_at(rgb[3 * i * PIXELS..].as_mut_ptr().cast())
        })
    }

    fn run(&mut self, options: &zs_render_options) -> zs_status {
        self.run_with(options, false)
    }

    fn run_with(&mut self, options: &zs_render_options, own: bool) -> zs_status {
        let (device, scene) = (open_device(), scene_of(&self.scene));
        let renderer = renderer(&device, &scene);
        let [color, alpha, depth] = &self.weights;
        let grads = [0, 1].map(|i| zs_grad_outputs {
            color: color[3 * i * PIXELS..].as_ptr(),
            alpha: alpha[i * PIXELS..].as_ptr(),
            depth: depth[i * PIXELS..].as_ptr(),
            ..Versioned::new()
        });
        let [means, scales, quats, opacities, sh_coeffs, cameras, means2d] =
            self.found.each_mut().map(|values| values.as_mut_ptr());
        let to = zs_gradients { means, scales, quats, opacities, sh_coeffs, cameras, means2d, ..Versioned::new() };
        let cameras = self.cameras.as_ptr();
        let scene = if own { null_mut() } else { scene.handle };
        unsafe { zs_render_backward(renderer.handle, scene, cameras, grads.as_ptr(), 2, options, &to) }
    }

    fn sum(&self, scene: &Scene, cameras: &[zs_camera; 2], options: &zs_render_options) -> f64 {
        let (device, scene) = (open_device(), scene_of(scene));
        let renderer = renderer(&device, &scene);
        let mut drawn = self.weights.clone();
        let pictures = Self::pictures(&mut drawn);
        ok(unsafe { zs_render(renderer.handle, cameras.as_ptr(), pictures.as_ptr(), 2, options) });
        let terms = drawn.iter().flatten().zip(self.weights.iter().flatten());
        terms.map(|(value, weight)| f64::from(*value) * f64::from(*weight)).sum()
    }
}

fn options(depth: zs_depth_mode) -> zs_render_options {
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGB_F32);
    let antialiasing = zs_antialiasing::ZS_ANTIALIASING_ON as i32;
    zs_render_options { depth: depth as i32, background: [0.2, 0.1, 0.4], antialiasing, ..options }
}

#[test]
fn are_rusts_bits() {
    for (depth, kind) in [
        (zs_depth_mode::ZS_DEPTH_MODE_ACCUMULATED, Depth::Accumulated),
        (zs_depth_mode::ZS_DEPTH_MODE_EXPECTED, Depth::Expected),
    ] {
        let mut case = Case::new();
        case.scene.means.iter_mut().for_each(|[x, y, _]| (*x, *y) = (0.1 * *x, 0.1 * *y));
        ok(case.run(&options(depth)));
        let frame = |i: usize| RenderOutput {
            width: SIZE[0],
            height: SIZE[1],
            rgb: Some(case.weights[0][3 * i * PIXELS..][..3 * PIXELS].to_vec()),
            alpha: Some(case.weights[1][i * PIXELS..][..PIXELS].to_vec()),
            depth: Some(case.weights[2][i * PIXELS..][..PIXELS].to_vec()),
            normals: None,
            token_colors: None,
        };
        let camera = |c: &zs_camera| Camera {
            intrinsics: Intrinsics { width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy },
            pose: Pose { rotation: glam::DMat3::IDENTITY, translation: c.translation.into() },
        };
        let request = RenderOptions {
            alpha: true,
            depth: Some(kind),
            background: [0.2, 0.1, 0.4],
            antialiased: Some(true),
            ..RenderOptions::default()
        };
        let (cameras, frames) = (case.cameras.each_ref().map(camera), [0, 1].map(frame));
        let wanted = Wanted { scene: true, cameras: true, means2d: true };
        let found = Differentiator::new(rust_device()).differentiate(&case.scene, &cameras, &request, &frames, wanted);
        let found = found.expect("gradients");
        assert_same("means", &case.found[0], found.scene.means.as_flattened());
        assert_same("scales", &case.found[1], found.scene.scales.as_flattened());
        assert_same("quats", &case.found[2], found.scene.quats.as_flattened());
        assert_same("opacities", &case.found[3], &found.scene.opacities);
        assert_same("sh_coeffs", &case.found[4], found.scene.sh_coeffs.as_flattened());
        assert_same("cameras", &case.found[5], found.cameras.as_flattened());
        assert_same("means2d", &case.found[6], found.means2d.as_flattened());
        // The principal point moves all centers; near the axis no slope is clamped.
        for (camera, centers) in found.cameras.iter().zip(found.means2d.chunks_exact(case.scene.len())) {
            for axis in 0..2 {
                let sum: f32 = centers.iter().map(|center| center[axis]).sum();
                let size: f32 = centers.iter().map(|center| center[axis].abs()).sum();
                assert!(size > 0.0 && (sum - camera[8 + axis]).abs() < 1e-5 * size, "{sum} {}", camera[8 + axis]);
            }
        }
        let given = std::mem::replace(&mut case.found, Case::new().found);
        ok(case.run_with(&options(depth), true));
        assert!(case.found == given, "the renderer's scene has other gradients");
    }
}

/// Of the largest element by kind. Only slopes include the motion of the edge at alpha 1/255.
#[test]
fn are_slopes_of_pictures() {
    let options = options(zs_depth_mode::ZS_DEPTH_MODE_ACCUMULATED);
    let mut case = Case::new();
    ok(case.run(&options));
    let strongest =
        |values: &[f32]| (0..values.len()).max_by(|a, b| values[*a].abs().total_cmp(&values[*b].abs())).unwrap();
    for (field, step) in [1e-3, 1e-3, 1e-2, 1e-3, 1e-2, 1e-4].into_iter().enumerate() {
        let at = strongest(&case.found[field]);
        let moved = |step: f64| {
            let (mut scene, mut cameras) = (case.scene.clone(), case.cameras);
            let values = match field {
                0 => scene.means.as_flattened_mut(),
                1 => scene.scales.as_flattened_mut(),
                2 => scene.quats.as_flattened_mut(),
                3 => &mut scene.opacities[..],
                4 => scene.sh_coeffs.as_flattened_mut(),
                _ => {
                    // For an unrotated camera, w is a small rotation.
                    let (camera, number) = (&mut cameras[at / CAMERA_NUMBERS], at % CAMERA_NUMBERS);
                    match number {
                        0..3 => {
                            let (a, b) = ((number + 1) % 3, (number + 2) % 3);
                            camera.rotation[3 * b + a] += step;
                            camera.rotation[3 * a + b] -= step;
                        }
                        3..6 => camera.translation[number - 3] += step,
                        _ => *[&mut camera.fx, &mut camera.fy, &mut camera.cx, &mut camera.cy][number - 6] += step,
                    }
                    return case.sum(&scene, &cameras, &options);
                }
            };
            values[at] += step as f32;
            case.sum(&scene, &cameras, &options)
        };
        let (slope, found) = ((moved(step) - moved(-step)) / (2.0 * step), f64::from(case.found[field][at]));
        assert!((slope - found).abs() < 0.15 * found.abs(), "field {field}: {found}, slope {slope}");
    }
}

#[test]
fn what_has_none_is_refused_and_nothing_is_written() {
    let good = options(zs_depth_mode::ZS_DEPTH_MODE_ACCUMULATED);
    let mut case = Case::new();
    case.scene.quats[3] = [1e-35, 0.0, 0.0, 0.0];
    fails(case.run(&good), ZS_ERROR_ARGUMENT, &["quats"]);
    case.scene.quats[3] = [1.0, 0.0, 0.0, 0.0];
    case.cameras[1].fx = f64::NAN;
    fails(case.run(&good), ZS_ERROR_ARGUMENT, &["camera 1"]);
    assert!(case.found.iter().flatten().all(|value| *value == 7.0));
    let status = unsafe { zs_render_backward(null(), null(), null(), null(), 0, null(), null()) };
    assert_eq!(status, ZS_ERROR_ARGUMENT);
}
