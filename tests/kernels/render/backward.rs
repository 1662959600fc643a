use crate::case::*;
use zipsplat::stages::render::{
    CAMERA_NUMBERS, CameraRows, FrameInputs, FrameShape, Gradients, SceneTensors, camera_rows,
};
use zipsplat_tests::reference::render::backward::{Direction, Drawing, Weights, along};
use zipsplat_tests::reference::render::rasterize::render;

/// Gradients of the sum of `d_frames` times frames.
struct Found {
    means: Vec<f32>,
    scales: Vec<f32>,
    quats: Vec<f32>,
    opacities: Vec<f32>,
    sh: Vec<f32>,
    cameras: Vec<f32>,
    status: Vec<u32>,
}

impl Found {
    /// Returns fields per Gaussian: golden's name, values and row width.
    fn fields(&self) -> [(&'static str, &[f32], usize); 5] {
        let coeffs = self.sh.len() / self.opacities.len();
        [
            ("means", &self.means, 3),
            ("scales", &self.scales, 3),
            ("quats", &self.quats, 4),
            ("opacities", &self.opacities, 1),
            ("sh", &self.sh, coeffs),
        ]
    }

    fn values(&self) -> Vec<f32> {
        self.fields().into_iter().flat_map(|(_, values, _)| values).chain(&self.cameras).copied().collect()
    }

    fn bits(&self) -> Vec<u32> {
        self.values().into_iter().map(f32::to_bits).collect()
    }
}

struct How<'a> {
    limits: &'a Limits,
    capacity: usize,
    before: f32,
    scene: bool,
    cameras: bool,
}

impl Default for How<'_> {
    fn default() -> Self {
        Self { limits: device().limits(), capacity: 1 << 16, before: 0.0, scene: true, cameras: true }
    }
}

fn find(scene: &Scene, cameras: &[Camera], request: &RenderOptions, d_frames: &[f32]) -> Found {
    How::default().find(scene, cameras, request, d_frames)
}

impl How<'_> {
    fn find(&self, scene: &Scene, cameras: &[Camera], request: &RenderOptions, d_frames: &[f32]) -> Found {
        let mut case = plan_within(self.limits);
        let tensors = SceneTensors {
            means: case.input(&scene.means),
            scales: case.input(&scene.scales),
            quats: case.input(&scene.quats),
            opacities: case.input(&scene.opacities),
            sh_coeffs: case.input(&scene.sh_coeffs),
            len: scene.len(),
            sh_degree: scene.sh_degree,
        };
        let d = SceneTensors {
            means: case.output::<[f32; 3]>(scene.len()),
            scales: case.output::<[f32; 3]>(scene.len()),
            quats: case.output::<[f32; 4]>(scene.len()),
            opacities: case.output::<f32>(scene.len()),
            sh_coeffs: case.output::<[f32; 3]>(scene.sh_coeffs.len()),
            ..tensors
        };
        let d_cameras = case.output::<[f32; CAMERA_NUMBERS]>(cameras.len());
        for tensor in d.all().into_iter().chain([d_cameras]) {
            case.rec.fill(tensor, self.before.to_bits());
        }
        let rows: Vec<CameraRows> = cameras.iter().map(camera_rows).collect();
        let (rows, d_frames) = (case.input(&rows), case.input(d_frames));
        let size = &cameras[0].intrinsics;
        let shape = FrameShape { cameras: cameras.len(), width: size.width, height: size.height };
        let gradients = Gradients { scene: self.scene.then_some(d), cameras: self.cameras.then_some(d_cameras) };
        let inputs = FrameInputs { scene: &tensors, cameras: rows, shape, options: request, capacity: self.capacity };
        let (outputs, _) = inputs.record_with_gradients(&mut case.rec, |_, _| d_frames, &gradients);
        let run = case.run().unwrap();
        let read = |tensor| run.read(tensor).unwrap();
        Found {
            means: read(d.means),
            scales: read(d.scales),
            quats: read(d.quats),
            opacities: read(d.opacities),
            sh: read(d.sh_coeffs),
            cameras: read(d_cameras),
            status: run.read(outputs.status).unwrap(),
        }
    }
}

fn weigh(weights: &Weights, request: &RenderOptions) -> Vec<f32> {
    let depth = request.depth.map(|_| (&weights.depth, 1));
    let planes = [request.rgb.then_some((&weights.rgb, 3)), request.alpha.then_some((&weights.alpha, 1)), depth];
    let planes: Vec<_> = planes.into_iter().flatten().collect();
    let pixel = |i: usize| planes.iter().flat_map(move |(plane, width)| plane[i * width..][..*width].to_vec());
    (0..weights.alpha.len()).flat_map(pixel).map(|weight| weight as f32).collect()
}

const SETS: [(&str, [bool; 3]); 5] = [
    ("rgb", [true, false, false]),
    ("alpha", [false, true, false]),
    ("D", [false, false, true]),
    ("ED", [false, true, true]),
    ("all", [true, true, true]),
];

/// Limits are relative to the total, and per row to its length and the longest.
fn hold(name: &str, got: &[f32], truth: &[f64], width: usize, [in_all, of_own, of_longest]: [f64; 3]) {
    assert_eq!(got.len(), truth.len(), "{name}");
    let length = |values: &[f64]| values.iter().map(|x| x * x).sum::<f64>().sqrt();
    let apart: Vec<f64> = got.iter().zip(truth).map(|(got, truth)| f64::from(*got) - truth).collect();
    let rms = length(&apart) / length(truth).max(f64::MIN_POSITIVE);
    assert!(rms <= in_all, "{name}: {rms:e} apart");
    let longest = truth.chunks(width).map(length).fold(0.0, f64::max);
    for (i, truth) in truth.chunks(width).enumerate() {
        let (got, apart) = (&got[i * width..][..width], length(&apart[i * width..][..width]));
        let most = of_own * length(truth) + of_longest * longest;
        assert!(apart <= most, "{name}: row {i} is {got:?}, truth {truth:?}, {apart:e} apart");
    }
}

/// Converts the gradient of the world-to-camera matrix to that of (w, v).
fn of_pose(d_view: &[f64], view: &[f64]) -> [f64; 6] {
    let at = |m: &[f64], c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
    let turn: DVec3 = (0..4).map(|c| -at(view, c).cross(at(d_view, c))).sum();
    let shift = -at(d_view, 3);
    [turn.x, turn.y, turn.z, shift.x, shift.y, shift.z]
}

#[test]
fn equals_the_goldens() {
    for file in golden::list("grad_raster.") {
        let Some(golden) = Golden::open(&file) else { continue };
        let (scene, cameras) = (golden_scene(&golden), golden_cameras(&golden));
        let background = <[f32; 3]>::try_from(golden.f32("bg")).unwrap();
        for mode in ["classic", "antialiased"].into_iter().filter(|mode| golden.has(&format!("{mode}/v_rgb"))) {
            let weights = |name: &str| golden.f64(&format!("{mode}/v_{name}"));
            let weights = Weights { rgb: weights("rgb"), alpha: weights("alpha"), depth: weights("depth") };
            for (set, [rgb, alpha, depth]) in SETS {
                let expected = set == "ED";
                let kind = if expected { Depth::Expected } else { Depth::Accumulated };
                let request = RenderOptions {
                    rgb,
                    alpha,
                    depth: depth.then_some(kind),
                    background,
                    antialiased: Some(mode == "antialiased"),
                    ..RenderOptions::default()
                };
                let no_alpha = || Weights { alpha: vec![0.0; weights.alpha.len()], ..weights.clone() };
                let weights = if expected { no_alpha() } else { weights.clone() };
                let found = find(&scene, &cameras, &request, &weigh(&weights, &request));
                compare(&golden, &format!("{mode}/{set}"), &found, expected);
            }
        }
    }
}

fn compare(golden: &Golden, key: &str, found: &Found, expected: bool) {
    let allowed = match (expected, golden.file().contains("hard")) {
        (true, _) => [3e-4, 1e-2, 1e-4],
        (false, true) => [1e-4, 1e-3, 1e-6],
        (false, false) => [3e-5, 1e-3, 1e-6],
    };
    let truth = |field: &str| golden.f64(&format!("{key}/d_{field}"));
    let name = |field: &str| format!("{} {key} {field}", golden.file());
    for (field, got, width) in found.fields() {
        if golden.has(&format!("{key}/d_{field}")) {
            hold(&name(field), got, &truth(field), width, allowed);
        }
    }
    let views = golden.f64("viewmats");
    let d_views = truth("viewmats");
    let poses: Vec<f64> = d_views.chunks(16).zip(views.chunks(16)).flat_map(|(d, view)| of_pose(d, view)).collect();
    if golden.has(&format!("{key}/d_c2w")) {
        let apart = poses.iter().zip(truth("c2w")).map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f64::max);
        assert!(apart < 1e-9, "pose gradients of the golden, {apart:e} apart");
    }
    let numbers = |range: std::ops::Range<usize>| -> Vec<f32> {
        found.cameras.chunks(CAMERA_NUMBERS).flat_map(|camera| camera[range.clone()].to_vec()).collect()
    };
    for (field, range, truth) in [("pose", 0..6, poses), ("f", 6..8, truth("f")), ("c", 8..10, truth("c"))] {
        let width = range.len();
        hold(&name(field), &numbers(range), &truth, width, allowed);
    }
}

const SIZE: [u32; 2] = [70, 53];

fn two_cameras() -> [Camera; 2] {
    let moved = |x: f64, turn: f64, [fx, cx]: [f64; 2]| {
        let mut camera = camera(SIZE[0], SIZE[1]);
        camera.pose = Pose { rotation: DMat3::from_rotation_y(turn), translation: DVec3::new(x, 0.2 * x, -0.1) };
        (camera.intrinsics.fx, camera.intrinsics.cx) = (fx, cx);
        camera
    };
    [moved(0.2, -0.1, [80.0, 31.0]), moved(-0.3, 0.15, [65.0, 38.0])]
}

fn requests() -> [(RenderOptions, Drawing); 4] {
    let request = |rgb, alpha, depth: Option<Depth>, antialiased| {
        let background = [0.3, 0.1, 0.6];
        let request = RenderOptions {
            antialiased: Some(antialiased),
            ..RenderOptions { rgb, alpha, depth, background, ..RenderOptions::default() }
        };
        let expected_depth = depth == Some(Depth::Expected);
        (request, Drawing { antialiased, expected_depth, background: background.map(f64::from) })
    };
    [
        request(true, false, None, false),
        request(true, true, Some(Depth::Accumulated), true),
        request(false, true, Some(Depth::Expected), false),
        request(true, true, Some(Depth::Expected), true),
    ]
}

/// 0 at pixels that rounding decides.
fn random_weights(scene: &Scene, cameras: &[Camera], request: &RenderOptions) -> Weights {
    let gaussians = reference_gaussians(scene);
    let antialiased = request.antialiased == Some(true);
    let unstable = |camera: &Camera| render(&gaussians, &reference_camera(camera), antialiased, [0.0; 3]).unstable;
    let stable: Vec<f64> = cameras.iter().flat_map(unstable).map(|mark| f64::from(1 - mark)).collect();
    let weights = |seed, width: usize, on: bool| -> Vec<f64> {
        let each = |(i, weight): (usize, f32)| if on { f64::from(weight) * stable[i / width] } else { 0.0 };
        random(seed, width * stable.len()).into_iter().enumerate().map(each).collect()
    };
    Weights {
        rgb: weights(1, 3, request.rgb),
        alpha: weights(2, 1, request.alpha),
        depth: weights(3, 1, request.depth.is_some()),
    }
}

/// In random directions of every field; rotations step by `turn`.
fn hold_to_differences(name: &str, scene: &Scene, turn: f64, request: RenderOptions, drawing: Drawing) {
    let cameras = &two_cameras();
    let weights = random_weights(scene, cameras, &request);
    let found = find(scene, cameras, &request, &weigh(&weights, &request));
    let gaussians = reference_gaussians(scene);
    let references: Vec<_> = cameras.iter().map(reference_camera).collect();
    for (round, field) in (0..12).zip(["means", "scales", "quats", "opacities", "sh", "cameras"].into_iter().cycle()) {
        let mut direction = Direction::still(&gaussians, cameras.len());
        let d = &mut direction.gaussians;
        let mut seed = 100 + round as u64;
        let mut along_it = |values: &mut [f64], sizes: &dyn Fn(usize) -> f64, got: &[f32]| -> [f64; 2] {
            seed += 1000;
            let random = random(seed, values.len());
            let mut sums = [0.0; 2];
            for (i, value) in values.iter_mut().enumerate() {
                *value = f64::from(random[i]) * sizes(i);
                let term = *value * f64::from(got[i]);
                sums = [sums[0] + term, sums[1] + term * term];
            }
            [sums[0], sums[1].sqrt()]
        };
        let [sum, size] = match field {
            "means" => along_it(d.means.as_flattened_mut(), &|i| gaussians.means[i / 3][2], &found.means),
            "scales" => along_it(d.scales.as_flattened_mut(), &|i| gaussians.scales[i / 3][i % 3], &found.scales),
            "quats" => along_it(d.quats.as_flattened_mut(), &|_| 1.0, &found.quats),
            "opacities" => along_it(&mut d.opacities, &|_| 1.0, &found.opacities),
            "sh" => along_it(&mut d.sh_coeffs, &|_| 1.0, &found.sh),
            _ => {
                along_it(direction.cameras.as_flattened_mut(), &|i| if i % 10 < 6 { 1.0 } else { 50.0 }, &found.cameras)
            }
        };
        let step = if matches!(field, "quats" | "cameras") { turn } else { 1e-7 };
        let truth = along(&gaussians, &references, drawing, &weights, &direction, step);
        let apart = (sum - truth).abs() / size.max(1e-12);
        assert!(apart < 1e-3, "{name} {field}: {sum}, truth {truth}, {apart:.1e} of their random sum apart");
    }
}

#[test]
fn equals_differences_at_every_degree_and_size() {
    for (degree, size) in [(0, 0.01), (1, 0.1), (2, 0.5), (3, 3.0)] {
        let mut scene = random_scene(150, degree, size);
        scene.opacities.iter_mut().step_by(5).for_each(|opacity| *opacity = 1.0); // clamps alphas
        for (i, (request, drawing)) in requests().into_iter().enumerate() {
            hold_to_differences(&format!("degree {degree}, request {i}"), &scene, 1e-7, request, drawing);
        }
    }
}

#[test]
fn equals_differences_of_needles_from_far_off_and_of_what_is_very_long() {
    let mut scene = random_scene(60, 1, 0.1);
    // A turn by 1e-7 moves alphas across their threshold.
    for i in 0..scene.len() {
        let turn = 0.3 * i as f32;
        scene.quats[i] = [(0.5 * turn).cos(), 0.0, 0.0, (0.5 * turn).sin()];
        let away = [6.0, 30.0, 0.2, 0.2][i % 4];
        scene.means[i] = [away * turn.cos(), away * turn.sin(), 2.0 + 0.05 * i as f32];
        scene.scales[i] = [[4.0, 20.0, 1e4, 1e8][i % 4], 0.02, 0.01];
    }
    for (i, (request, drawing)) in requests().into_iter().enumerate() {
        hold_to_differences(&format!("needles, request {i}"), &scene, 1e-8, request, drawing);
    }
}

fn many_tiles(count: usize) -> (Scene, RenderOptions, Vec<f32>) {
    let scene = random_scene(count, 1, 0.2);
    let request = requests()[1].0;
    let weights = random(9, 2 * (SIZE[0] * SIZE[1]) as usize * request.channels());
    (scene, request, weights)
}

#[test]
fn gives_the_same_bits_again_and_adds_to_what_is_there() {
    let (scene, request, d_frames) = many_tiles(2_000);
    let cameras = two_cameras();
    let first = find(&scene, &cameras, &request, &d_frames);
    assert!(first.values().iter().filter(|x| **x != 0.0).count() > scene.len());
    assert_eq!(find(&scene, &cameras, &request, &d_frames).bits(), first.bits());
    let added = How { before: 0.25, ..How::default() }.find(&scene, &cameras, &request, &d_frames);
    let expected: Vec<f32> = first.values().into_iter().map(|x| x + 0.25).collect();
    assert_eq!(added.values(), expected);
}

#[test]
fn gpu_paths_agree() {
    let (cameras, (scene, _, _)) = (two_cameras(), many_tiles(2_000));
    for (request, _) in requests() {
        let d_frames = random(9, 2 * (SIZE[0] * SIZE[1]) as usize * request.channels());
        let [cpu, gpu] = [true, false].map(|cpu| {
            let limits = Limits { cpu, ..device().limits().clone() };
            How { limits: &limits, ..How::default() }.find(&scene, &cameras, &request, &d_frames)
        });
        assert!(!device().limits().cpu || gpu.bits() == cpu.bits());
        // GPU compilers contract multiplications differently in each.
        assert_close("both paths", &gpu.values(), &cpu.values(), Tolerance { max: 1e-4, rms: 1e-5 });
    }
}

#[test]
fn what_is_not_asked_for_is_left_alone() {
    let (scene, request, d_frames) = many_tiles(300);
    let cameras = two_cameras();
    let both = find(&scene, &cameras, &request, &d_frames);
    let only_scene = How { cameras: false, ..How::default() }.find(&scene, &cameras, &request, &d_frames);
    let only_cameras = How { scene: false, ..How::default() }.find(&scene, &cameras, &request, &d_frames);
    assert_eq!((&only_scene.means, &only_scene.sh), (&both.means, &both.sh));
    assert!(only_scene.cameras.iter().all(|x| *x == 0.0));
    assert_eq!(only_cameras.cameras, both.cameras);
    assert!(only_cameras.fields().into_iter().all(|(_, values, _)| values.iter().all(|x| *x == 0.0)));
}

#[test]
fn too_little_room_adds_nothing() {
    let (scene, request, d_frames) = many_tiles(300);
    let enough = find(&scene, &two_cameras(), &request, &d_frames);
    let needed = enough.status[1] as usize;
    assert!(enough.values().iter().any(|x| *x != 0.0));
    let found =
        |capacity| How { capacity, before: 0.5, ..How::default() }.find(&scene, &two_cameras(), &request, &d_frames);
    for capacity in [1, needed / 2, needed - 1] {
        assert!(found(capacity).values().iter().all(|x| *x == 0.5), "capacity {capacity} of {needed}");
    }
    assert!(found(needed).values().iter().any(|x| *x != 0.5));
}

#[test]
fn small_bindings_cut_scenes_and_pictures() {
    let (scene, camera) = (random_scene(2_500, 3, 0.02), camera(100, 200));
    let request = requests()[1].0;
    let d_frames = random(5, 100 * 200 * request.channels());
    // Coefficients of 192 bytes and rows of 2,000 bytes make two parts and two bands.
    let found = |max_binding_bytes| {
        let limits = Limits { max_binding_bytes, ..device().limits().clone() };
        How { limits: &limits, capacity: 12_000, ..How::default() }.find(&scene, &[camera], &request, &d_frames)
    };
    let whole = found(128 << 20);
    assert!(whole.status[0] == whole.status[1] && whole.values().iter().any(|x| *x != 0.0));
    assert_eq!(found(288 << 10).bits(), whole.bits());
}

#[test]
#[should_panic(expected = "no gradient")]
fn normals_are_refused() {
    let (scene, request, d_frames) = many_tiles(10);
    find(&scene, &two_cameras(), &RenderOptions { normals: true, ..request }, &d_frames);
}
