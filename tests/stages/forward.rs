use std::collections::HashMap;
use zipsplat_tests::networks::{images, model};
use zipsplat_tests::prelude::*;
use zipsplat_tests::{reference::backbone::patchify::Images, reference::forward, reference::model::Model as Reference};

fn tap_tolerance(arithmetic: Arithmetic, key: &str) -> Tolerance {
    match arithmetic.element {
        Element::F32 => Tolerance::of_tap(key),
        _ => Tolerance::tap_in(arithmetic),
    }
}

fn cameras(golden: &Golden) -> Option<Vec<Camera>> {
    golden.has("in/camera").then(|| {
        let (cameras, poses) = (golden.f64("in/camera"), golden.f64("in/pose"));
        let camera = |(c, p): (&[f64], &[f64])| Camera {
            intrinsics: Intrinsics { width: c[0] as u32, height: c[1] as u32, fx: c[2], fy: c[3], cx: c[4], cy: c[5] },
            pose: scenes::pose(p),
        };
        cameras.chunks(6).zip(poses.chunks(12)).map(camera).collect()
    })
}

fn observe(model: &Model, images: &[Image], request: &ReconstructOptions) -> HashMap<String, Vec<f32>> {
    let run = networks::observe(model, images, request);
    run.observed().iter().map(|(name, tensor)| (name.clone(), run.read(*tensor).unwrap())).collect()
}

/// Independent of the ratio, and the rest.
fn tap_names(a: &Architecture) -> (Vec<String>, Vec<String>) {
    let layers = a.out_layers.len();
    let mut before: Vec<String> = ["bb/tokens0", "bb/alt_in", "bb/cam_token", "color/tokens"].map(String::from).into();
    before.extend((0..a.depth).map(|i| format!("bb/block{i}")));
    before.extend((0..layers).map(|j| format!("prep/layer{j}")));
    let mut after: Vec<String> = ["scene_init", "color_feats", "raw"].map(String::from).into();
    after.extend((0..layers).flat_map(|l| [format!("ca{l}_delta"), format!("scene_ca{l}"), format!("scene_sa{l}")]));
    (before, after)
}

/// Checks k-means only in f32.
fn check(file: &str, arithmetic: Arithmetic) {
    let Some(golden) = Golden::open(file) else { return };
    let config = file.split('.').next().expect("config.case");
    let model = model(config, arithmetic);
    let (images, cameras) = (images(&golden), cameras(&golden));
    let (before, after) = tap_names(model.architecture());
    let stored = |key: &str| golden.has(key) || golden.has(&format!("{key}@sub"));
    let mut compared = 0;
    for (ratio, prefix) in golden.compressions() {
        let key = |name: &str| format!("{prefix}/{name}");
        let given = TokenSelection::Given(golden.u32(&key("nearest_idx")));
        let request = ReconstructOptions { cameras: cameras.clone(), ..networks::options(ratio, given) };
        let taps = observe(&model, &images, &request);
        let names = before.iter().map(|n| (n, n.clone())).chain(after.iter().map(|n| (n, key(n))));
        for (name, key) in names.filter(|(_, key)| stored(key)) {
            assert_tap_within(&golden, &key, &taps[name], tap_tolerance(arithmetic, &key));
            compared += 1;
        }
        let scene = reconstruct(&model, &images, &request).to_scene().unwrap();
        check_gaussians(&golden, &key("gauss"), &packed(&scene), &model, arithmetic);
        if ratio < 1.0 && arithmetic == Arithmetic::EXACT {
            check_clusters(
                &golden,
                &model,
                &images,
                ReconstructOptions { token_selection: TokenSelection::KMEANS, ..request },
                &prefix,
            );
        }
    }
    assert!(compared > 10, "{file}: only {compared} taps compared");
}

/// Large goldens store every `sub_step`-th row.
fn check_gaussians(golden: &Golden, key: &str, packed: &[f32], model: &Model, arithmetic: Arithmetic) {
    let width = model.architecture().gaussian_width();
    let tolerance = |field: &str| match arithmetic.element {
        Element::F32 => Tolerance::of_field(field),
        _ => Tolerance::gaussians_in(arithmetic),
    };
    if golden.has(key) {
        assert_gaussians_within(key, packed, &golden.f32(key), width, tolerance);
        return;
    }
    let step = golden.i64("sub_step")[0] as usize;
    let kept: Vec<f32> = packed.chunks_exact(width).step_by(step).flatten().copied().collect();
    assert_gaussians_within(key, &kept, &golden.f32(&format!("{key}@sub")), width, tolerance);
}

fn check_clusters(golden: &Golden, model: &Model, images: &[Image], request: ReconstructOptions, prefix: &str) {
    let run = networks::observe(model, images, &request);
    let find = |name: &str| networks::observed(&run, name);
    let key = |name: &str| format!("{prefix}/{name}");
    let assigned: Vec<i64> = run.read::<u32>(find("assign")).unwrap().iter().map(|i| *i as i64).collect();
    assert_same(&key("assign"), &assigned, &golden.i64(&key("assign")));
    let centroids = run.read::<f32>(find("centroids")).unwrap();
    let tolerance = Tolerance::of_tap("centroids");
    assert_tap_within(golden, &key("centroids"), &centroids, tolerance);
    let nearest: Vec<u32> = run.read(find("nearest")).unwrap();
    assert_nearest(&key("nearest_idx"), &nearest, &golden.i64(&key("nearest_top2")), &golden.f32(&key("nearest_gap")));
}

/// Assignment and representatives of half of the tokens.
fn clusters(config: &str, arithmetic: Arithmetic, images: &[Image]) -> [Vec<u32>; 2] {
    let model = model(config, arithmetic);
    let request = ReconstructOptions { ratio: Ratio::Fixed(0.5), ..ReconstructOptions::default() };
    let observed = observe(&model, images, &request);
    let indices = |name: &str| observed[name].iter().map(|bits| bits.to_bits()).collect::<Vec<_>>();
    [indices("assign"), indices("nearest")]
}

#[test]
fn matrix_units_cluster_as_lanes() {
    for (config, file) in [("micro", "micro.v2.safetensors"), ("tiny_rect", "tiny_rect.v1.safetensors")] {
        let images = images(&Golden::committed(file));
        for arithmetic in fast_arithmetics().into_iter().filter(|arithmetic| arithmetic.nearest.is_some()) {
            let matrix = clusters(config, arithmetic, &images);
            let lanes = clusters(config, Arithmetic { nearest: None, ..arithmetic }, &images);
            for (found, truth) in matrix.iter().zip(&lanes) {
                assert_same(file, found, truth);
            }
        }
    }
}

/// Nearly equidistant tokens may move, except in clusters of two.
#[test]
fn every_arithmetic_chooses_about_the_same_tokens() {
    for (config, file) in [("micro", "micro.v2.safetensors"), ("tiny_rect", "tiny_rect.v1.safetensors")] {
        let images = images(&Golden::committed(file));
        let [_, truth] = clusters(config, Arithmetic::EXACT, &images);
        for arithmetic in fast_arithmetics().into_iter().filter(|a| a.element == Element::F16 && !a.has_integers()) {
            let [_, found] = clusters(config, arithmetic, &images);
            let apart = found.iter().zip(&truth).filter(|(a, b)| a != b).count();
            assert!(20 * apart <= truth.len(), "{file}: {apart} of {} differ, {arithmetic:?}", truth.len());
        }
    }
}

/// Factors coarser than f16, and runs without matrix units, check one golden: the dispatches are
/// the same.
fn check_all(config: &str, arithmetics: &[Arithmetic]) {
    let files = golden::list(&format!("{config}."));
    let files = files.iter().filter(|f| f.ends_with(".safetensors") && !f.contains(".weights."));
    for (i, file) in files.enumerate() {
        let coarse = |a: &Arithmetic| a.element == Element::Bf16 || a.has_integers();
        let again = |a: &Arithmetic| a.element == Element::F32 || a.linear.is_some() && !coarse(a);
        let wanted = arithmetics.iter().filter(|arithmetic| i == 0 || again(arithmetic));
        wanted.for_each(|arithmetic| check(file, *arithmetic));
    }
}

/// Against `tools/train/check.py dump`. Limits are the table's or three times PyTorch's f32
/// deviation: trained scales have a long tail.
#[test]
fn builtin() {
    let golden = Golden::open("embedded.safetensors").expect("it is committed");
    let checkpoint = Checkpoint::builtin().expect("the feature is on");
    let model =
        Model::from_checkpoint(device(), &checkpoint, |_| std::ops::ControlFlow::Continue(())).expect("it fits");
    let images = images(&golden);
    for (case, cameras) in [("plain", None), ("priors", cameras(&golden))] {
        for (ratio, name) in [(1.0, "r1"), (0.5, "r0.5")] {
            let key = |part: &str| format!("{case}/{name}/{part}");
            let nearest = |key| TokenSelection::Given(golden.u32(key));
            let selection = if ratio < 1.0 { nearest(&key("nearest_idx")) } else { TokenSelection::KMEANS };
            let request = ReconstructOptions { cameras: cameras.clone(), ..networks::options(ratio, selection) };
            let found = reconstruct(&model, &images, &request);
            let tolerance = |field: &str| {
                let table = Tolerance::of_field(field);
                let in_f32 = f64::from(golden.f32(&key(&format!("f32_deviation/{field}")))[0]);
                Tolerance { max: table.max.max(3.0 * in_f32), ..table }
            };
            let (name, width) = (key("gauss"), model.architecture().gaussian_width());
            assert_gaussians_within(&name, &packed(&found.to_scene().unwrap()), &golden.f32(&name), width, tolerance);
        }
    }
}

#[test]
fn pooled_keys() {
    let golden = Golden::committed("micro.v2_native.safetensors");
    let reference = Reference::generated("micro", &golden::json("micro.manifest.json").expect("it is committed"));
    let views = Images::from_u8(&golden.u8("in/images_u8"), golden.shape("in/images_u8"));
    let chosen = vec![49, 0, 12, 30, 7];
    for rule in ["2", "3+own", "local/2+own+first", "2+first"] {
        let pool: KvPool = rule.parse().unwrap();
        let mut tokens = forward::tokens(&reference, &views, None, &network::keys(pool));
        let mut truth = forward::gaussians(&reference, &tokens, &chosen);
        truth.append(&mut tokens.taps);
        for arithmetic in [Arithmetic::EXACT].into_iter().chain(fast_arithmetics()) {
            let request = ReconstructOptions {
                token_selection: TokenSelection::Given(chosen.clone()),
                kv_pool: pool,
                ..ReconstructOptions::default()
            };
            let taps = observe(&model("micro", arithmetic), &images(&golden), &request);
            for name in ["bb/block1", "bb/block2", "prep/layer0", "prep/layer1", "ca0_delta", "scene_sa1", "raw"] {
                let name = name.to_owned();
                assert_close(&name, &taps[&name], &truth[&name], tap_tolerance(arithmetic, &name));
            }
        }
    }
}

macro_rules! configurations {
    ($($exact:ident $fast:ident $config:literal),*) => { $(
        #[test]
        fn $exact() {
            check_all($config, &[Arithmetic::EXACT]);
        }

        #[test]
        fn $fast() {
            check_all($config, &fast_arithmetics());
        }
    )* };
}

configurations!(
    micro micro_fast "micro",
    tiny tiny_fast "tiny",
    tiny_with_small_activations tiny_with_small_activations_fast "tiny_eps",
    tiny_not_square tiny_not_square_fast "tiny_rect",
    tiny_with_swiglu tiny_with_swiglu_fast "tiny_swiglu",
    small_is_vits small_is_vits_fast "small",
    slice_of_the_giant slice_of_the_giant_fast "giant_slice"
);
