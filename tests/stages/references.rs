//! The f64 references reproduce PyTorch.

use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::backbone::camera_encoder::{Prior, encode, quat_from_rotation};
use zipsplat_tests::reference::backbone::{positions, rope};
use zipsplat_tests::reference::cluster::kmeans::{cluster_count, initial_indices, kmeans};
use zipsplat_tests::reference::ops::activation::{gelu, sigmoid, silu, softplus};
use zipsplat_tests::reference::ops::split_heads::Keys;
use zipsplat_tests::reference::render::project::{Camera, Gaussians, Splat, project};
use zipsplat_tests::{
    reference::backbone::patchify::Images,
    reference::forward,
    reference::forward::Tokens,
    reference::gaussians::activate::activate,
    reference::model::{Model, Taps},
    reference::ops::layer_norm::layer_norm,
    reference::render::rasterize::render,
    reference::render::sh,
};

const STORED: Tolerance = Tolerance::STORED;

#[test]
fn activations_and_layer_norm() {
    let golden = Golden::committed("geometry.safetensors");
    let x = golden.f64("ops/x");
    let compare = |name: &str, function: fn(f64) -> f64| {
        let got: Vec<f64> = x.iter().map(|&x| function(x)).collect();
        assert_close(name, &got, &golden.f32(&format!("ops/{name}")), STORED);
    };
    compare("gelu", gelu);
    compare("silu", silu);
    compare("sigmoid", sigmoid);
    compare("softplus_xm4", |x| softplus(x - 4.0));
    let (x, weight, bias) = (golden.f64("ops/ln_x"), golden.f32("ops/ln_w"), golden.f32("ops/ln_b"));
    for (eps, key) in [(1e-5, "ops/ln_1e-05"), (1e-6, "ops/ln_1e-06")] {
        assert_close(key, &layer_norm(&x, &weight, &bias, eps), &golden.f32(key), STORED);
    }
}

#[test]
fn head_activation() {
    let golden = Golden::committed("geometry.safetensors");
    let width = golden.shape("head/gauss")[1];
    let raw = golden.f64("head/raw");
    let got: Vec<f64> = raw.chunks(width).flat_map(activate).collect();
    assert_gaussians_within("head", &got, &golden.f32("head/gauss"), width, |_| STORED);
}

#[test]
fn position_grids() {
    let golden = Golden::committed("geometry.safetensors");
    let embed = golden.f64("pos/embed");
    let grids = golden.keys().into_iter().filter(|key| key.starts_with("pos/") && key.contains('x'));
    for key in grids {
        let (rows, columns) = key["pos/".len()..].split_once('x').expect("rows x columns");
        let got = positions::interpolate(&embed, 6, rows.parse().unwrap(), columns.parse().unwrap());
        assert_close(&key, &got, &golden.f32(&key), STORED);
    }
    assert_eq!(positions::interpolate(&embed, 6, 37, 37), embed);
}

#[test]
fn rotary_positions() {
    let golden = Golden::committed("geometry.safetensors");
    let positions: Vec<[f64; 2]> = golden.i64("rope/pos").chunks(2).map(|p| [p[0] as f64, p[1] as f64]).collect();
    for head_dim in [16, 32, 64] {
        // [1, heads, tokens, head_dim].
        let q = golden.f64(&format!("rope/q{head_dim}"));
        let heads = q.chunks(positions.len() * head_dim);
        let got: Vec<f64> = heads.flat_map(|head| rope::rope(head, &positions, head_dim)).collect();
        assert_close("rope", &got, &golden.f32(&format!("rope/out{head_dim}")), STORED);
    }
}

#[test]
fn camera_priors() {
    let golden = Golden::committed("geometry.safetensors");
    let rotations = golden.f64("quat/R");
    let quats = rotations
        .chunks(9)
        .flat_map(|r| quat_from_rotation([0, 1, 2].map(|row| [r[3 * row], r[3 * row + 1], r[3 * row + 2]])));
    assert_close("quat", &quats.collect::<Vec<_>>(), &golden.f32("quat/wxyz"), STORED);
    let priors = priors(&golden.f64("prior/camera"), &golden.f64("pose/data"));
    let got: Vec<f64> = priors.iter().flat_map(encode).collect();
    assert_close("encoding", &got, &golden.f32("prior/encoding"), STORED);
}

fn priors(cameras: &[f64], poses: &[f64]) -> Vec<Prior> {
    let views = cameras.chunks(6).zip(poses.chunks(12));
    views.map(|(camera, pose)| Prior { camera: camera.try_into().unwrap(), pose: pose.try_into().unwrap() }).collect()
}

#[test]
fn first_centroids() {
    let golden = Golden::committed("kmeans.safetensors");
    for key in golden.keys().into_iter().filter(|key| key.starts_with("linspace/")) {
        let (tokens, k) = key["linspace/".len()..].split_once('_').expect("tokens_k");
        let got = initial_indices(tokens.parse().unwrap(), k.parse().unwrap());
        assert_same(&key, &got, &golden.u32(&key));
    }
    for row in golden.f64("k_of_compression@f64").chunks(3) {
        assert_eq!(cluster_count(row[0] as usize, row[1]), row[2] as usize, "{row:?}");
    }
}

#[test]
fn clusters() {
    let golden = Golden::committed("kmeans.safetensors");
    let cases = golden.stems("/x");
    assert!(cases.len() >= 10);
    for case in cases {
        let key = |name: &str| format!("{case}/{name}");
        let (x, width) = (golden.f64(&key("x")), golden.shape(&key("x"))[1]);
        let clusters = kmeans(&x, width, golden.i64(&key("K"))[0] as usize);
        assert_same(&key("assign_iters"), &clusters.assignments.concat(), &golden.u32(&key("assign_iters_exact")));
        let gaps = golden.f64(&key("nearest_gap"));
        let clear: Vec<usize> = (0..gaps.len()).filter(|&k| gaps[k] > 1e-4).collect();
        let pick = |indices: &[u32]| clear.iter().map(|&k| indices[k]).collect::<Vec<_>>();
        assert_same(&key("nearest"), &pick(&clusters.nearest), &pick(&golden.u32(&key("nearest_exact"))));
        assert_close(&key("centroids"), &clusters.centroids, &golden.f32(&key("centroids_exact")), STORED);
        assert_as_near(&case, &clusters.nearest, &clusters.centroids, &x, width);
        for (k, (gap, truth)) in clusters.gaps.iter().zip(gaps).enumerate() {
            assert!((gap - truth).abs() < 1e-6, "{case}: gap of cluster {k} is {gap}, truth {truth}");
        }
    }
}

#[test]
fn spherical_harmonics() {
    let direction = glam::DVec3::new(0.3, -0.8, 0.4).normalize();
    let [x, y, z] = direction.to_array();
    // With the signs of 3D Gaussian splatting.
    let truth = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2.0 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3.0 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
        -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3.0 * y * y),
    ];
    assert_close("basis", &sh::basis(3, direction), &truth, Tolerance { max: 1e-14, rms: 1e-14 });
}

/// Large ones if present.
const SCENES: [&str; 6] = ["single", "opaque_stack", "rand50", "edge", "offcentre", "sh2000"];

fn scene(golden: &Golden) -> (Gaussians, Vec<Camera>) {
    let rows3 = |key: &str| golden.f64(key).chunks(3).map(|row| row.try_into().unwrap()).collect();
    let gaussians = Gaussians {
        means: rows3("means"),
        scales: rows3("scales"),
        quats: golden.f64("quats").chunks(4).map(|row| row.try_into().unwrap()).collect(),
        opacities: golden.f64("opacities"),
        sh_coeffs: golden.f64("sh"),
    };
    let size = golden.i64("size_wh");
    let size = [size[0] as usize, size[1] as usize];
    let (viewmats, ks) = (golden.f64("viewmats"), golden.f64("Ks"));
    let cameras = viewmats.chunks(16).zip(ks.chunks(9)).map(|(viewmat, k)| Camera::new(viewmat, k, size));
    (gaussians, cameras.collect())
}

#[test]
fn projections() {
    for golden in SCENES.iter().filter_map(|scene| Golden::open(&format!("raster.{scene}.safetensors"))) {
        let (gaussians, cameras) = scene(&golden);
        for (mode, antialiased) in [("classic", false), ("antialiased", true)] {
            let splats: Vec<Option<Splat>> =
                cameras.iter().flat_map(|camera| project(&gaussians, camera, antialiased)).collect();
            let key = |name: &str| format!("proj/{mode}/{name}");
            let name = |field: &str| format!("{} {mode} {field}", golden.file());
            let ok: Vec<u8> = splats.iter().map(|splat| u8::from(splat.is_some())).collect();
            assert_same(&name("ok"), &ok, &golden.u8(&key("ok")));
            // Pictures span many magnitudes.
            let compare = |field: &str, got: &dyn Fn(&Splat) -> Vec<f64>, width: usize| {
                let truth = golden.f64(&key(field));
                for (i, (splat, truth)) in splats.iter().zip(truth.chunks(width)).enumerate() {
                    // The goldens also have colors of invisible Gaussians.
                    let Some(got) = splat.as_ref().map(got) else { continue };
                    let scale = truth.iter().fold(1e-30f64, |a, x| a.max(x.abs()));
                    let apart = got.iter().zip(truth).fold(0.0f64, |a, (g, t)| a.max((g - t).abs()));
                    assert!(apart <= 2e-7 * scale, "{} of {i}: {got:?}, truth {truth:?}", name(field));
                }
            };
            compare("means2d", &|splat| splat.mean.to_vec(), 2);
            compare("depth", &|splat| vec![splat.depth], 1);
            compare("conic", &|splat| splat.conic.to_vec(), 3);
            compare("opac", &|splat| vec![splat.opacity], 1);
            compare("color", &|splat| splat.color.to_vec(), 3);
            if antialiased {
                compare("comp", &|splat| vec![splat.compensation], 1);
            }
            let integers = |field: &dyn Fn(&Splat) -> [u32; 2]| -> Vec<u32> {
                splats.iter().flat_map(|splat| splat.as_ref().map_or([0, 0], field)).collect()
            };
            assert_same(&name("radii"), &integers(&|splat| splat.radii), &golden.u32(&key("radii")));
            assert_same(&name("tmin"), &integers(&|splat| splat.tiles[0]), &golden.u32(&key("tmin")));
            assert_same(&name("tmax"), &integers(&|splat| splat.tiles[1]), &golden.u32(&key("tmax")));
        }
    }
}

#[test]
fn renderings() {
    for golden in SCENES.iter().filter_map(|scene| Golden::open(&format!("raster.{scene}.safetensors"))) {
        let (gaussians, cameras) = scene(&golden);
        let [width, height] = cameras[0].size;
        for (mode, antialiased) in [("classic", false), ("antialiased", true)] {
            for (view, camera) in cameras.iter().enumerate() {
                let rendering = render(&gaussians, camera, antialiased, [0.0; 3]);
                let key = |what: &str| format!("v153/{mode}/{what}");
                let pixels = view * width * height..(view + 1) * width * height;
                assert_same(&key("unstable"), &rendering.unstable, &golden.u8(&key("unstable"))[pixels.clone()]);
                let compare = |what: &str, values: &[f64], channels: usize| {
                    let truth = &golden.f64(&key(what))[pixels.start * channels..pixels.end * channels];
                    let picture = Picture { values, width, channels };
                    let name = format!("{} {} {view}", golden.file(), key(what));
                    assert_images_close(&name, picture, truth, &[], ImageTolerance::STORED);
                };
                compare("rgb", &rendering.rgb, 3);
                compare("alpha", &rendering.alpha, 1);
                compare("D", &rendering.depth, 1);
                compare("ED", &rendering.expected_depth, 1);
                if !antialiased {
                    let background = golden.f64("bg").try_into().unwrap();
                    compare("rgb_bg", &render(&gaussians, camera, antialiased, background).rgb, 3);
                }
            }
        }
    }
}

#[test]
fn forward_micro() {
    forward_passes("micro", &["micro.v2", "micro.v2_native", "micro.v2_priors"]);
}

#[test]
fn forward_tiny() {
    forward_passes("tiny", &["tiny.v3", "tiny.v3_priors"]);
}

#[test]
fn forward_tiny_rect() {
    let cases = ["v1", "v2", "v2_priors", "v2_tall", "v1_full"].map(|case| format!("tiny_rect.{case}"));
    forward_passes("tiny", &cases.each_ref().map(String::as_str));
}

#[test]
fn forward_tiny_swiglu() {
    forward_passes("tiny_swiglu", &["tiny_swiglu.v3", "tiny_swiglu.v3_priors"]);
}

#[test]
fn forward_tiny_eps() {
    forward_passes("tiny_eps", &["tiny_eps.v3", "tiny_eps.v3_priors"]);
}

#[test]
fn forward_small() {
    forward_passes("small", &["small.v2"]);
}

fn forward_passes(config: &str, cases: &[&str]) {
    let Some(manifest) = zipsplat_tests::golden::json(&format!("{config}.manifest.json")) else { return };
    let model = Model::generated(config, &manifest);
    for golden in cases.iter().filter_map(|case| Golden::open(&format!("{case}.safetensors"))) {
        forward_pass(&model, &golden);
    }
}

fn forward_pass(model: &Model, golden: &Golden) {
    let images = Images::from_u8(&golden.u8("in/images_u8"), golden.shape("in/images_u8"));
    let known = golden.has("in/pose").then(|| priors(&golden.f64("in/camera"), &golden.f64("in/pose")));
    let tokens = forward::tokens(model, &images, known.as_deref(), &Keys::all());
    let mut compared = compare_taps(golden, "", &tokens.taps);
    for (ratio, prefix) in golden.compressions() {
        compare_clusters(model, golden, &tokens, ratio, &prefix);
        let taps = forward::gaussians(model, &tokens, &golden.u32(&format!("{prefix}/nearest_idx")));
        compared += compare_taps(golden, &format!("{prefix}/"), &taps);
    }
    let taps = golden.keys().into_iter().filter(|key| {
        let name = key.rsplit('/').next().expect("a name");
        let counted = !name.ends_with("@sum") && !key.starts_with("in/") && name != "sub_step";
        counted && !["is_global", "nearest", "centroids", "assign"].iter().any(|other| name.starts_with(other))
    });
    assert_eq!(compared, taps.count(), "{}: every tap is compared", golden.file());
}

fn compare_taps(golden: &Golden, prefix: &str, taps: &Taps) -> usize {
    let mut compared = 0;
    for (name, values) in taps {
        let key = format!("{prefix}{name}");
        if golden.has(&key) || golden.has(&format!("{key}@sub")) {
            assert_tap_within(golden, &key, values, STORED);
            compared += 1;
        }
    }
    compared
}

fn compare_clusters(model: &Model, golden: &Golden, tokens: &Tokens, ratio: f64, prefix: &str) {
    let width = model.architecture.width;
    let count = tokens.layers[0].len() / width;
    let k = cluster_count(count, ratio);
    assert_eq!(golden.shape(&format!("{prefix}/nearest_idx")), [k]);
    if k == count {
        return assert_same(
            prefix,
            &golden.u32(&format!("{prefix}/nearest_idx")),
            &(0..count as u32).collect::<Vec<_>>(),
        );
    }
    let clusters = kmeans(&tokens.layers[0], width, k);
    let assignments = clusters.assignments.last().expect("five rounds");
    assert_same("assign", assignments, &golden.u32(&format!("{prefix}/assign")));
    assert_tap_within(golden, &format!("{prefix}/centroids"), &clusters.centroids, STORED);
    let gap = golden.f32(&format!("{prefix}/nearest_gap"));
    assert_nearest(prefix, &clusters.nearest, &golden.i64(&format!("{prefix}/nearest_top2")), &gap);
}
