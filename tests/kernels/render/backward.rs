//! Gradients of pictures against the goldens and against finite differences of the reference.

use crate::case::Case;
use zipsplat::{
    gpu::Limits,
    stages::render::{
        CAMERA_NUMBERS, CameraRows, Depth, FrameShape, Gradients, RenderRequest, SceneGradients, SceneTensors,
        camera_rows, record_with_gradients,
    },
    types::{Camera, Scene},
};
use zipsplat_tests::{
    device::device,
    golden::{self, Golden},
    reference::render::backward::Weights,
    scenes::{golden_cameras, golden_scene},
};

/// What is in front of every output before gradients are added to it.
const BEFORE: f32 = 0.0;

/// Gradients of the sum of `d_frames` times frames, in the order of the goldens' keys.
#[derive(Debug)]
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

    fn bits(&self) -> Vec<u32> {
        let all = self.fields().into_iter().flat_map(|(_, values, _)| values).chain(&self.cameras);
        all.map(|x| x.to_bits()).collect()
    }
}

fn find(scene: &Scene, cameras: &[Camera], request: &RenderRequest, d_frames: &[f32]) -> Found {
    find_within(device().limits(), scene, cameras, request, d_frames, 1 << 16)
}

fn find_within(
    limits: &Limits,
    scene: &Scene,
    cameras: &[Camera],
    request: &RenderRequest,
    d_frames: &[f32],
    capacity: usize,
) -> Found {
    let mut case = Case::within(limits);
    let tensors = SceneTensors {
        means: case.input(&scene.means),
        scales: case.input(&scene.scales),
        quats: case.input(&scene.quats),
        opacities: case.input(&scene.opacities),
        sh_coeffs: case.input(&scene.sh_coeffs),
        len: scene.len(),
        sh_degree: scene.sh_degree,
    };
    let d = SceneGradients {
        means: case.output::<[f32; 3]>(scene.len()),
        scales: case.output::<[f32; 3]>(scene.len()),
        quats: case.output::<[f32; 4]>(scene.len()),
        opacities: case.output::<f32>(scene.len()),
        sh_coeffs: case.output::<[f32; 3]>(scene.sh_coeffs.len()),
    };
    let d_cameras = case.output::<[f32; CAMERA_NUMBERS]>(cameras.len());
    for tensor in [d.means, d.scales, d.quats, d.opacities, d.sh_coeffs, d_cameras] {
        case.rec.fill(tensor, BEFORE.to_bits());
    }
    let rows: Vec<CameraRows> = cameras.iter().map(camera_rows).collect();
    let (rows, d_frames) = (case.input(&rows), case.input(d_frames));
    let size = &cameras[0].intrinsics;
    let shape = FrameShape { cameras: cameras.len(), width: size.width, height: size.height };
    let gradients = Gradients { scene: Some(d), cameras: Some(d_cameras) };
    let outputs =
        record_with_gradients(&mut case.rec, &tensors, rows, shape, request, capacity, |_, _| d_frames, &gradients);
    let run = case.run();
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

/// A request for outputs whose weights are given, interleaved as in frames.
fn weigh(weights: &Weights, request: &RenderRequest) -> Vec<f32> {
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

/// The largest deviation of values and of rows, as shares of what is allowed.
fn deviation(name: &str, got: &[f32], truth: &[f64], width: usize, rms: f64, row: [f64; 2]) -> [f64; 2] {
    assert_eq!(got.len(), truth.len(), "{name}");
    assert!(got.iter().all(|x| x.is_finite()), "{name}: not finite");
    let length = |values: &[f64]| values.iter().map(|x| x * x).sum::<f64>().sqrt();
    let apart: Vec<f64> = got.iter().zip(truth).map(|(got, truth)| f64::from(*got) - truth).collect();
    let largest = truth.chunks(width).map(length).fold(0.0, f64::max);
    let whole = length(&apart) / (rms * length(truth)).max(f64::MIN_POSITIVE);
    let rows = apart.chunks(width).zip(truth.chunks(width)).enumerate();
    let worst = rows.map(|(i, (apart, truth))| {
        // A row of nothing but rounding, where all are, is compared with nothing.
        (length(apart) / (row[0] * length(truth) + row[1] * largest).max(1e-30), i)
    });
    let (of_row, i) = worst.fold((0.0, 0), |a, b| if b.0 > a.0 { b } else { a });
    let show = |at: usize| (&got[at * width..][..width], &truth[at * width..][..width]);
    assert!(
        whole <= 1.0 && of_row <= 1.0,
        "{name}: rms {whole:.3}, row {i} {of_row:.3} of what is allowed: {:?}",
        show(i)
    );
    [whole, of_row]
}

/// The gradient of (w, v) from that of the world-to-camera matrix.
fn of_pose(d_view: &[f64], view: &[f64]) -> [f64; 6] {
    let at = |m: &[f64], c: usize| glam::DVec3::new(m[c], m[4 + c], m[8 + c]);
    let turn: glam::DVec3 = (0..4).map(|c| -at(view, c).cross(at(d_view, c))).sum();
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
                let request = RenderRequest {
                    rgb,
                    alpha,
                    depth: depth.then_some(kind),
                    background,
                    antialiased: mode == "antialiased",
                    ..RenderRequest::default()
                };
                let mut weights = weights.clone();
                if expected {
                    weights.alpha.fill(0.0);
                }
                let found = find(&scene, &cameras, &request, &weigh(&weights, &request));
                compare(&golden, &format!("{mode}/{set}"), &found, expected);
            }
        }
    }
}

fn compare(golden: &Golden, key: &str, found: &Found, expected: bool) {
    let hard = golden.file().contains("hard");
    let rms = if expected {
        3e-4
    } else if hard {
        1e-4
    } else {
        3e-5
    };
    let row = if expected { [1e-2, 1e-4] } else { [1e-3, 1e-6] };
    let truth = |field: &str| golden.f64(&format!("{key}/d_{field}"));
    let mut margins = Vec::new();
    for (field, got, width) in found.fields() {
        if golden.has(&format!("{key}/d_{field}")) {
            let name = format!("{} {key} {field}", golden.file());
            margins.push((field, deviation(&name, got, &truth(field), width, rms, row)));
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
    // What is just past the near plane drowns the others in `hard`.
    let row = if hard { [1e-2, 1e-4] } else { row };
    for (field, range, truth) in [("pose", 0..6, poses), ("f", 6..8, truth("f")), ("c", 8..10, truth("c"))] {
        let name = format!("{} {key} {field}", golden.file());
        let width = range.len();
        let rms = if hard { 1e-3 } else { rms };
        margins.push((field, deviation(&name, &numbers(range), &truth, width, rms, row)));
    }
    if std::env::var_os("ZIPSPLAT_MARGINS").is_some() {
        eprintln!("{} {key}: {margins:.2?}", golden.file());
    }
}
