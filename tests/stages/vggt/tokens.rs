//! ZipSplat's decoder on VGGT has no released weights: against the f64 reference.

use crate::depth_reference::pictures;
use zipsplat::{
    gpu::Profile,
    reconstruct::{Network, Shape},
};
use zipsplat_tests::prelude::*;
use zipsplat_tests::reference::forward;

fn architecture() -> Architecture {
    architectures::vggt_micro()
}

fn model(arithmetic: Arithmetic) -> Model {
    let checkpoint = Checkpoint::seeded_architecture(architecture(), "micro").unwrap();
    Model::from_checkpoint_with(device(), &checkpoint, arithmetic, |_| ControlFlow::Continue(())).unwrap()
}

#[test]
fn the_decoder_on_vggt_is_the_reference() {
    let images = pictures(3, [70, 42]);
    let checkpoint = Checkpoint::seeded_architecture(architecture(), "micro").unwrap();
    let (reference, chosen) = (network::model(&checkpoint).unwrap(), vec![44, 0, 12, 30, 7]);
    for rule in ["1", "2", "local/2+own+first"] {
        let pool: KvPool = rule.parse().unwrap();
        let tokens = forward::tokens(&reference, &network::images(&images), None, &network::keys(pool));
        let truth = forward::gaussians(&reference, &tokens, &chosen);
        for arithmetic in [Arithmetic::EXACT].into_iter().chain(fast_arithmetics()) {
            let (model, selection) = (model(arithmetic), TokenSelection::Given(chosen.clone()));
            let request = ReconstructOptions { kv_pool: pool, ..networks::options(0.1, selection) };
            let run = networks::observe(&model, &images, &request);
            let within = |key: &str| match arithmetic.element {
                Element::F32 => Tolerance::of_tap(key),
                _ => Tolerance::tap_in(arithmetic),
            };
            let check = |key: &str, truth: &[f64]| {
                let got: Vec<f32> = run.read(networks::observed(&run, key)).unwrap();
                assert_close(&format!("{key}, {arithmetic:?}"), &got, truth, within(key));
            };
            tokens.layers.iter().enumerate().for_each(|(j, layer)| check(&format!("prep/layer{j}"), layer));
            ["scene_init", "ca0_delta", "scene_sa1", "color_feats", "raw"]
                .iter()
                .for_each(|key| check(key, &truth[*key]));
        }
    }
}

#[test]
fn known_cameras_are_refused() {
    let images = pictures(2, [42, 28]);
    let cameras = Some(vec![camera(42, 28); 2]);
    let request = ReconstructOptions { cameras, ..ReconstructOptions::default() };
    assert_refused(model(Arithmetic::EXACT).shape(&images, &request), &["cameras", "vggt", "has no camera encoder"]);
}

#[test]
fn files_of_the_decoder_on_vggt_are_read() {
    let folder = tempfile::TempDir::new().unwrap();
    let path = folder.path().join("vggt.safetensors");
    let checkpoint = Checkpoint::seeded_architecture(architecture(), "micro").unwrap();
    checkpoint.save(&path, Dtype::F16).unwrap();
    assert_eq!(Checkpoint::open(&path, None).unwrap().architecture(), &architecture());
}

/// Tera operations of the aggregator, by views and side.
#[test]
fn work_of_vggt_is_as_stated() {
    let architecture = Architecture::named("vggt").unwrap();
    architecture.validate().unwrap();
    let limits = Limits::default();
    let network = Network::new(&architecture, &limits, Arithmetic::EXACT);
    for (views, side, stated) in [(24, 252, 21.0), (24, 518, 175.6), (192, 252, 510.9), (192, 518, 7391.0)] {
        let shape =
            Shape::new(&architecture, views, [side; 2], Ratio::Fixed(0.01), &TokenSelection::Stride, false).unwrap();
        let profile = Profile::outline(&network.plan(&limits, shape).unwrap().plan);
        let patches = views * (side as usize / 14).pow(2);
        // The decoder's layers on features are counted too.
        let merged = 3.0 * 2.0 * patches as f64 * 2048.0 * 1024.0 / 1e12;
        let found = profile.total("backbone").1 as f64 / 1e12 - merged;
        assert!((found - stated).abs() < 0.005 * stated, "{views} views of {side}: {found:.2}, stated {stated}");
    }
}
