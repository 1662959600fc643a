use serde_json::Value;
use std::collections::BTreeSet;
use zipsplat::Scene;
use zipsplat::depth::{DepthMap, DepthModel, DepthOptions, DepthPrediction, pixel_gaussians};
use zipsplat::weights::{DepthArchitecture, DepthCheckpoint, Ffn};
use zipsplat_tests::compare::Float;
use zipsplat_tests::networks::{images, observed};
use zipsplat_tests::prelude::*;

pub(crate) fn architecture(config: &str) -> DepthArchitecture {
    let manifest = golden::json(&format!("{config}.manifest.json")).expect("it lies beside the goldens");
    let conf = &manifest["conf"];
    let number = |value: &Value| value.as_u64().expect("a whole number") as usize;
    let four = |key: &str| -> [usize; 4] { std::array::from_fn(|i| number(&conf[key][i])) };
    let depth = number(&conf["depth"]);
    if conf.get("trunk").is_some() {
        let blocks = [number(&conf["dino_depth"]), depth];
        let [width, features] = ["D", "features"].map(|key| number(&conf[key]));
        let mut found = DepthArchitecture::vggt(config, width, blocks, four("layers"), features, four("channels"));
        (found.backbone.heads, found.points) = (number(&conf["heads"]), true);
        found.backbone.position_grid = number(&conf["size"]) / 14;
        let camera = found.camera_head.as_mut().expect("a head for cameras");
        (camera.depth, camera.heads) = (number(&conf["trunk"]), number(&conf["cam_heads"]));
        return found;
    }
    let alt = conf["alt"].as_u64().map_or(depth, |alt| alt as usize);
    let ffn = if conf["ffn"].is_string() { Ffn::SwiGlu } else { Ffn::Gelu };
    let [width, features] = ["D", "features"].map(|key| number(&conf[key]));
    let mut found = DepthArchitecture::new(config, [width, depth, alt], ffn, four("out"), features, four("channels"));
    found.backbone.heads = number(&conf["heads"]);
    found
}

fn model(golden: &Golden) -> DepthModel {
    let config = config(golden);
    let architecture = DepthArchitecture { gaussians: golden.has("gs/means"), ..architecture(config) };
    let checkpoint = DepthCheckpoint::seeded(architecture, config).expect("a golden's network");
    DepthModel::from_checkpoint(device(), &checkpoint, Arithmetic::EXACT, |_| std::ops::ControlFlow::Continue(()))
        .unwrap()
}

pub(crate) fn config(golden: &Golden) -> &str {
    golden.file().split('.').next().expect("config.case")
}

fn cameras(golden: &Golden) -> Option<Vec<Camera>> {
    golden.has("in/extrinsics").then(|| {
        let (extrinsics, intrinsics) = (golden.f64("in/extrinsics"), golden.f64("in/intrinsics"));
        let shape = golden.shape("in/images_u8");
        let [height, width] = [shape[2], shape[3]].map(|side| side as u32);
        let camera = |(e, k)| scenes::camera_of([e, k], [width, height]);
        extrinsics.chunks(16).zip(intrinsics.chunks(9)).map(camera).collect()
    })
}

pub(crate) struct Observed {
    run: Run,
    pub depths: DepthPrediction,
}

impl Observed {
    pub fn new(golden: &Golden) -> Self {
        let model = model(golden);
        let images = images(golden);
        let request = DepthOptions { cameras: cameras(golden), ..DepthOptions::default() };
        let shape = model.shape(&images, &request).unwrap();
        let (plan, tensors) = model.record(shape, true).unwrap();
        let mut run = model.run(plan).unwrap();
        model.write_inputs(&mut run, &tensors, shape, &images, &request).unwrap();
        run.execute().unwrap();
        let depths = model.predict(&images, &request, |_| std::ops::ControlFlow::Continue(())).unwrap();
        Self { run, depths }
    }

    pub fn taps(&self, name: &str) -> Vec<Vec<f32>> {
        let named = self.run.observed().iter().filter(|(other, _)| other == name);
        named.map(|(_, tensor)| self.run.read(*tensor).unwrap()).collect()
    }
}

/// `[pixels, channels]` to `[channels, pixels]`, every `step`-th channel.
pub(crate) fn planar(values: &[f32], channels: usize, step: usize) -> Vec<f32> {
    (0..channels).step_by(step).flat_map(|c| values[c..].iter().step_by(channels)).copied().collect()
}

/// At least three times PyTorch's f32 deviation.
pub(crate) fn tolerance(tap: &str) -> Tolerance {
    let max = match tap {
        _ if tap.starts_with("bb/feat") => 1.5e-5,
        _ if tap.contains("logits") => 5e-5,
        _ => 3e-5,
    };
    Tolerance { max, rms: max / 3.0 }
}

pub(crate) fn compare(golden: &Golden, key: &str, got: &[impl Float], tolerance: Tolerance) {
    assert_close(&format!("{} {key}", golden.file()), got, &golden.f64(key), tolerance);
}

fn check_backbone(golden: &Golden, observed: &Observed) -> usize {
    let mut compared = 0;
    let alt = architecture(config(golden)).backbone.alt_start;
    let reference = observed.taps("bb/ref_idx").first().map_or(0, |index| index[0].to_bits() as usize);
    if golden.has("bb/ref_idx") {
        assert_eq!(golden.i64("bb/ref_idx"), [reference as i64], "{}", golden.file());
        let scores = |values: &[f64]| values.iter().skip(3).step_by(4).copied().collect::<Vec<_>>();
        let found: Vec<f64> = observed.taps("bb/ref_metrics")[0].iter().map(|&x| f64::from(x)).collect();
        let allowed = Tolerance { max: 1e-3, rms: 1e-3 };
        assert_close("scores", &scores(&found), &scores(&golden.f64("bb/ref_metrics")), allowed);
        compared += 1;
    }
    for key in golden.keys().into_iter().filter(|key| key.starts_with("bb/")) {
        let block = key.strip_prefix("bb/block").map(|block| 1 + block.parse::<usize>().expect("a number"));
        // The last tap before the first global block includes camera tokens.
        let tap = if block == Some(alt) { "bb/alt_in" } else { &key };
        let Some(mut got) = observed.taps(tap).into_iter().next().filter(|_| !key.contains("ref_")) else { continue };
        if block.is_some_and(|block| block >= alt) {
            // PyTorch has the reference view first from here on.
            let per_view = got.len() / golden.shape(&key)[0];
            got[..(reference + 1) * per_view].rotate_right(per_view);
        }
        compare(golden, &key, &got, tolerance(&key));
        compared += 1;
    }
    compared
}

fn check_heads(golden: &Golden, observed: &Observed) -> usize {
    let mut compared = 0;
    let dense = |key: &String| (key.starts_with("head/") || key.starts_with("gs/")) && golden.shape(key).len() == 4;
    for key in golden.keys().into_iter().filter(dense) {
        let (taps, shape) = (observed.taps(&key), golden.shape(&key));
        assert!(!taps.is_empty(), "{}: {key} is not observed", golden.file());
        let step = if key.ends_with("/up") { 2 } else { 1 };
        let channels = step * shape[1];
        let got: Vec<f32> = taps[taps.len() - shape[0]..].iter().flat_map(|tap| planar(tap, channels, step)).collect();
        compare(golden, &key, &got, tolerance(&key));
        compared += 1;
    }
    compared
}

/// Logarithms, as depths span many magnitudes.
fn check_outputs(golden: &Golden, observed: &Observed) -> usize {
    let views = &observed.depths.views;
    let mut compared = 0;
    let mut check = |key: &str, got: Vec<f32>, tolerance: f64, logarithm: bool| {
        if !golden.has(key) {
            return;
        }
        let truth = golden.f64(key);
        assert_eq!(got.len(), truth.len(), "{key}");
        let scale = (truth.iter().map(|x| x * x).sum::<f64>() / truth.len() as f64).sqrt();
        for (i, (&got, truth)) in got.iter().zip(truth).enumerate() {
            let got = f64::from(got);
            let apart = if logarithm { (got.ln() - truth.ln()).abs() } else { (got - truth).abs() / scale };
            assert!(apart <= tolerance, "{} {key} [{i}] is {got}, truth {truth}", golden.file());
        }
        compared += 1;
    };
    let all =
        |of: &dyn Fn(&DepthMap) -> Option<Vec<f32>>| -> Vec<f32> { views.iter().filter_map(of).flatten().collect() };
    check("out/depth", all(&|view| Some(view.depth.clone())), 1e-4, true);
    check("out/depth_conf", all(&|view| view.confidence.clone()), 1e-4, true);
    check("out/sky", all(&|view| view.sky.clone()), 5e-5, false);
    // PyTorch joins the pixels of all views.
    let joined = |of: fn(&DepthMap) -> Option<&Vec<f32>>| views.iter().filter_map(of).flatten().copied().collect();
    let (depth, sky) = (joined(|view| Some(&view.depth)), joined(|view| view.sky.as_ref()));
    let all_views = DepthMap { depth, sky: Some(sky), ..views[0].clone() };
    check("out/depth_after_sky", all_views.depth_behind_sky(), 1e-4, true);
    let joined = |view: &DepthMap| {
        let rays = view.rays.as_ref()?;
        Some(rays.directions.iter().zip(&rays.origins).flat_map(|(d, o)| [*d, *o].concat()).collect())
    };
    check("out/ray", all(&joined), 5e-5, false);
    check("out/ray_conf", all(&|view| view.rays.as_ref().map(|rays| rays.confidence.clone())), 1e-4, true);
    check("cam/encoding", all(&|view| view.encoding.map(Vec::from)), 3e-5, false);
    compared
}

/// World-to-camera.
fn check_cameras(golden: &Golden, observed: &Observed) {
    let cameras = observed.depths.cameras().unwrap();
    let extrinsics = cameras.iter().flat_map(|camera| camera.view_matrix().transpose().to_cols_array()[..12].to_vec());
    let lenses = cameras.iter().flat_map(|camera| camera.intrinsics.matrix().transpose().to_cols_array());
    let within = Tolerance { max: 5e-5, rms: 2e-5 };
    assert_close("extrinsics", &extrinsics.collect::<Vec<_>>(), &golden.f64("out/cam_extrinsics"), within);
    assert_close("intrinsics", &lenses.collect::<Vec<_>>(), &golden.f64("out/cam_intrinsics"), within);
}

fn check_gaussians(golden: &Golden, observed: &Observed) {
    let cameras = observed.depths.cameras().unwrap();
    let view = |(view, camera): (&DepthMap, &Camera)| {
        pixel_gaussians(&view.depth, view.gaussians.as_ref().expect("the network has the head"), camera)
    };
    let scenes: Vec<Scene> = observed.depths.views.iter().zip(&cameras).map(view).collect();
    hold_gaussians(golden, "gs", &scenes, Tolerance { max: 1e-3, rms: 3e-4 });
}

fn hold_gaussians(golden: &Golden, root: &str, scenes: &[Scene], within: Tolerance) {
    let check = |key: &str, of: &dyn Fn(&Scene) -> Vec<f32>| {
        let key = format!("{root}/{key}");
        assert_close(&key, &scenes.iter().flat_map(of).collect::<Vec<_>>(), &golden.f64(&key), within);
    };
    check("means", &|scene| scene.means.concat());
    check("scales", &|scene| scene.scales.concat());
    check("quats_wxyz", &|scene| scene.quats.concat());
    check("opacities", &|scene| scene.opacities.clone());
    // The golden stores coefficients by color.
    let by_color = |scene: &Scene| {
        let gaussian = |coeffs: &[[f32; 3]]| (0..3).flat_map(|c| coeffs.iter().map(move |k| k[c])).collect::<Vec<_>>();
        scene.sh_coeffs.chunks(9).flat_map(gaussian).collect()
    };
    check("sh", &by_color);
}

#[test]
fn gaussians_of_pixels() {
    let Some(golden) = Golden::open("da3_units.safetensors") else { return };
    let (depth, raw, opacity) = (golden.f64("adapter/depth"), golden.f64("adapter/raw"), golden.f64("adapter/opacity"));
    let (poses, lenses) = (golden.f64("adapter/c2w"), golden.f64("adapter/K"));
    let [_, height, width] = golden.shape("adapter/depth") else { panic!("views of pixels") };
    let pixels = height * width;
    let view = |i: usize| {
        let part = i * pixels..(i + 1) * pixels;
        let logit = |p: f64| (p / (1.0 - p)).ln();
        let values: Vec<f32> = part
            .clone()
            .flat_map(|pixel| {
                raw[37 * pixel..][..37].iter().copied().chain([logit(opacity[pixel])]).collect::<Vec<_>>()
            })
            .map(|x| x as f32)
            .collect();
        let pose = glam::DMat4::from_cols_slice(&poses[16 * i..][..16]).transpose();
        let pose = Pose { rotation: glam::DMat3::from_mat4(pose), translation: pose.w_axis.truncate() };
        let k = &lenses[9 * i..];
        let (w, h) = (*width as u32, *height as u32);
        let intrinsics = Intrinsics { width: w, height: h, fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
        let depth: Vec<f32> = depth[part].iter().map(|&x| x as f32).collect();
        pixel_gaussians(&depth, &values, &Camera { intrinsics, pose })
    };
    hold_gaussians(&golden, "adapter", &[view(0), view(1)], Tolerance { max: 2e-6, rms: 1e-6 });
}

fn check_all(config: &str) {
    for golden in golden::list(&format!("{config}.")).iter().filter_map(|file| Golden::open(file)) {
        let observed = Observed::new(&golden);
        let compared =
            [check_backbone(&golden, &observed), check_heads(&golden, &observed), check_outputs(&golden, &observed)];
        assert!(compared.iter().all(|&count| count >= 2), "{}: {compared:?}", golden.file());
        if golden.has("out/cam_extrinsics") {
            check_cameras(&golden, &observed);
        }
        if golden.has("gs/means") {
            check_gaussians(&golden, &observed);
        }
    }
}

#[test]
fn parts_of_maps_make_the_same_bits() {
    let Some(golden) = Golden::open("da3_tiny.v1.safetensors") else { return };
    let model = model(&golden);
    let (width, height) = (196, 140);
    let rgb = random(1, 3 * width * height).iter().map(|x| (127.0 + 127.0 * x) as u8).collect();
    let images = [Image::new(width as u32, height as u32, rgb).unwrap()];
    let request = DepthOptions::default();
    let shape = model.shape(&images, &request).unwrap();
    let logits = |max_binding_bytes: u64| {
        let limits = device().limits();
        let max_binding_bytes = limits.max_binding_bytes.min(max_binding_bytes);
        let mut rec = Recorder::new(&Limits { max_binding_bytes, ..limits.clone() }).observing();
        let tensors = model.network().record(&mut rec, shape);
        let plan = rec.finish().unwrap();
        let commands = plan.len();
        let mut run = model.run(plan).unwrap();
        model.write_inputs(&mut run, &tensors, shape, &images, &request).unwrap();
        run.execute().unwrap();
        let read = |name: &str| run.read::<u32>(observed(&run, name)).unwrap();
        (commands, ["head/fuse0", "head/up", "head/logits", "head/logits_aux"].map(read))
    };
    let ((few, whole), (more, parts)) = (logits(u64::MAX), logits(400 << 10));
    assert!(more > few + 20, "{few} commands, {more} in parts");
    for (parts, whole) in parts.iter().zip(&whole) {
        assert_same("in parts", parts, whole);
    }
}

const KNOWN: [&str; 6] = ["da3_tiny", "da3_odd4", "da3_mono", "da3_rays", "da3_units", "da3_pre"];

#[test]
fn other_configurations() {
    let files = golden::list("da3_");
    let configs = files.iter().filter_map(|file| Some(file.split_once('.')?.0));
    let others: BTreeSet<&str> = configs.filter(|config| !KNOWN.contains(config)).collect();
    others.into_iter().for_each(check_all);
}

#[test]
fn views_that_see_each_other() {
    check_all("da3_tiny");
}

#[test]
fn swiglu_and_an_odd_first_global_block() {
    check_all("da3_odd4");
}

#[test]
fn views_by_themselves() {
    check_all("da3_mono");
}
