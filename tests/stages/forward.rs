//! The forward pass against the dumps of the PyTorch implementation, tap by tap, and its invariants.

use std::collections::HashMap;
use zipsplat::gpu::Run;
use zipsplat::reconstruct::{Model, Ratio, Request, Selection};
use zipsplat::types::{Camera, Image, Intrinsics, Pose, Scene};
use zipsplat::weights::{Architecture, Checkpoint};
use zipsplat_tests::architectures;
use zipsplat_tests::compare::{assert_gaussians_close, assert_nearest, assert_same, assert_tap};
use zipsplat_tests::device::device;
use zipsplat_tests::golden::{self, Golden};

/// A model of generated weights, as the goldens use.
fn model(config: &str) -> Model {
    let key = if config == "tiny_rect" { "tiny" } else { config };
    let checkpoint = Checkpoint::seeded_architecture(architectures::golden(config), key).expect("a golden's network");
    Model::load(device(), &checkpoint, |_| std::ops::ControlFlow::Continue(())).expect("small models fit")
}

/// `in/images_u8` `[views, 3, height, width]` as pictures.
fn images(golden: &Golden) -> Vec<Image> {
    let (shape, values) = (golden.shape("in/images_u8"), golden.u8("in/images_u8"));
    let (height, width) = (shape[2], shape[3]);
    let area = height * width;
    let picture = |view: &[u8]| {
        let rgb = (0..area).flat_map(|i| [view[i], view[area + i], view[2 * area + i]]).collect();
        Image::new(width as u32, height as u32, rgb).expect("golden images are whole")
    };
    values.chunks(3 * area).map(picture).collect()
}

/// `in/camera` and `in/pose`, where a case has priors.
fn cameras(golden: &Golden) -> Option<Vec<Camera>> {
    golden.has("in/camera").then(|| {
        let (cameras, poses) = (golden.f64("in/camera"), golden.f64("in/pose"));
        let camera = |(c, p): (&[f64], &[f64])| Camera {
            intrinsics: Intrinsics { width: c[0] as u32, height: c[1] as u32, fx: c[2], fy: c[3], cx: c[4], cy: c[5] },
            pose: Pose {
                rotation: glam::DMat3::from_cols_slice(&p[..9]).transpose(),
                translation: glam::DVec3::from_slice(&p[9..]),
            },
        };
        cameras.chunks(6).zip(poses.chunks(12)).map(camera).collect()
    })
}

/// Runs a request and returns everything that was observed.
fn observe(model: &Model, images: &[Image], request: &Request) -> (HashMap<String, Vec<f32>>, Run) {
    let shape = model.shape(images, request).unwrap();
    let (plan, tensors) = model.record(shape, true).unwrap();
    let mut run = model.run(plan).unwrap();
    model.write_inputs(&mut run, &tensors, shape, images, request).unwrap();
    run.execute().unwrap();
    let read = |(name, tensor): &(String, _)| (name.clone(), run.read::<f32>(*tensor).unwrap());
    let taps = run.observed().iter().map(read).collect();
    (taps, run)
}

/// Taps that do not depend on the ratio, and those that do.
fn tap_names(a: &Architecture) -> (Vec<String>, Vec<String>) {
    let layers = a.out_layers.len();
    let mut before: Vec<String> = ["bb/tokens0", "bb/alt_in", "bb/cam_token", "color/tokens"].map(String::from).into();
    before.extend((0..a.depth).map(|i| format!("bb/block{i}")));
    before.extend((0..layers).map(|j| format!("prep/layer{j}")));
    let mut after: Vec<String> = ["scene_init", "color_feats", "raw"].map(String::from).into();
    after.extend((0..layers).flat_map(|l| [format!("ca{l}_delta"), format!("scene_ca{l}"), format!("scene_sa{l}")]));
    (before, after)
}

/// Every tap of one golden, with its own choice of tokens; then what k-means chooses.
fn check(file: &str) {
    let Some(golden) = Golden::open(file) else { return };
    let config = file.split('.').next().expect("config.case");
    let model = model(config);
    let (images, cameras) = (images(&golden), cameras(&golden));
    let (before, after) = tap_names(model.architecture());
    let stored = |key: &str| golden.has(key) || golden.has(&format!("{key}@sub"));
    let mut compared = 0;
    for (ratio, prefix) in golden.compressions() {
        let key = |name: &str| format!("{prefix}/{name}");
        let given = golden.i64(&key("nearest_idx")).iter().map(|i| *i as u32).collect();
        let request =
            Request { ratio: Ratio::Fixed(ratio), selection: Selection::Given(given), cameras: cameras.clone() };
        let (taps, _) = observe(&model, &images, &request);
        let names = before.iter().map(|n| (n, n.clone())).chain(after.iter().map(|n| (n, key(n))));
        for (name, key) in names.filter(|(_, key)| stored(key)) {
            assert_tap(&golden, &key, &taps[name]);
            compared += 1;
        }
        let scene = model.reconstruct(&images, &request, |_| std::ops::ControlFlow::Continue(())).unwrap().scene;
        check_gaussians(&golden, &key("gauss"), &packed(&scene), model.architecture().gaussian_width());
        if ratio < 1.0 {
            check_clusters(&golden, &model, &images, Request { selection: Selection::KMEANS, ..request }, &prefix);
        }
    }
    assert!(compared > 10, "{file}: only {compared} taps compared");
}

/// A scene as the goldens have it: `[n, width]` of means, scales, quats, opacity and SH coefficients.
fn packed(scene: &Scene) -> Vec<f32> {
    let k = scene.sh_coeffs_per_gaussian();
    let gaussian = |i: usize| {
        let head = scene.means[i].into_iter().chain(scene.scales[i]).chain(scene.quats[i]);
        head.chain([scene.opacities[i]]).chain(scene.sh_coeffs[i * k..][..k].as_flattened().iter().copied())
    };
    (0..scene.len()).flat_map(gaussian).collect()
}

/// Packed Gaussians `[n, width]`, of which large goldens store every `sub_step`-th.
fn check_gaussians(golden: &Golden, key: &str, packed: &[f32], width: usize) {
    if golden.has(key) {
        assert_gaussians_close(key, packed, &golden.f32(key), width);
        return;
    }
    let step = golden.i64("sub_step")[0] as usize;
    let kept: Vec<f32> = packed.chunks_exact(width).step_by(step).flatten().copied().collect();
    assert_gaussians_close(key, &kept, &golden.f32(&format!("{key}@sub")), width);
}

fn check_clusters(golden: &Golden, model: &Model, images: &[Image], request: Request, prefix: &str) {
    let shape = model.shape(images, &request).unwrap();
    let (plan, tensors) = model.record(shape, true).unwrap();
    let mut run = model.run(plan).unwrap();
    model.write_inputs(&mut run, &tensors, shape, images, &request).unwrap();
    run.execute().unwrap();
    let find = |name: &str| run.observed().iter().find(|o| o.0 == name).expect("clustering observes it").1;
    let key = |name: &str| format!("{prefix}/{name}");
    let assigned: Vec<i64> = run.read::<u32>(find("assign")).unwrap().iter().map(|i| *i as i64).collect();
    assert_same(&key("assign"), &assigned, &golden.i64(&key("assign")));
    assert_tap(golden, &key("centroids"), &run.read::<f32>(find("centroids")).unwrap());
    let nearest: Vec<u32> = run.read(find("nearest")).unwrap();
    assert_nearest(&key("nearest_idx"), &nearest, &golden.i64(&key("nearest_top2")), &golden.f32(&key("nearest_gap")));
}

/// Every golden of a configuration, committed or in the larger set.
fn check_all(config: &str) {
    let files = golden::list(&format!("{config}."));
    for file in files.iter().filter(|f| f.ends_with(".safetensors") && !f.contains(".weights.")) {
        check(file);
    }
}

/// The model that is shipped, with and without cameras, all tokens and half of them: against our own PyTorch code in f64
/// (`tools/train/check.py dump`).
#[test]
fn embedded() {
    let golden = Golden::open("embedded.safetensors").expect("it is committed");
    let checkpoint = Checkpoint::embedded().expect("the feature is on");
    let model = Model::load(device(), &checkpoint, |_| std::ops::ControlFlow::Continue(())).expect("it fits");
    let images = images(&golden);
    for (case, cameras) in [("plain", None), ("priors", cameras(&golden))] {
        for (ratio, name) in [(1.0, "r1"), (0.5, "r0.5")] {
            let key = |part: &str| format!("{case}/{name}/{part}");
            let nearest = |key| Selection::Given(golden.i64(key).iter().map(|i| *i as u32).collect());
            let selection = if ratio < 1.0 { nearest(&key("nearest_idx")) } else { Selection::KMEANS };
            let request = Request { ratio: Ratio::Fixed(ratio), selection, cameras: cameras.clone() };
            let found = model.reconstruct(&images, &request, |_| std::ops::ControlFlow::Continue(())).unwrap();
            check_gaussians(&golden, &key("gauss"), &packed(&found.scene), model.architecture().gaussian_width());
        }
    }
}

#[test]
fn micro() {
    check_all("micro");
}

#[test]
fn tiny() {
    check_all("tiny");
}

#[test]
fn tiny_with_small_activations() {
    check_all("tiny_eps");
}

#[test]
fn tiny_not_square() {
    check_all("tiny_rect");
}

#[test]
fn tiny_with_swiglu() {
    check_all("tiny_swiglu");
}

#[test]
fn small_is_vits() {
    check_all("small");
}

#[test]
fn slice_of_the_giant() {
    check_all("giant_slice");
}
