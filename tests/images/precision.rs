//! Pictures of networks in faster arithmetics, against f32.

use zipsplat_tests::networks::{images, model};
use zipsplat_tests::prelude::*;

/// Uses the golden's own tokens at the first ratio.
fn scene_of(golden: &Golden, config: &str, arithmetic: Arithmetic) -> Scene {
    let (ratio, prefix) = golden.compressions()[0].clone();
    let selection = TokenSelection::Given(golden.u32(&format!("{prefix}/nearest_idx")));
    let options = networks::options(ratio, selection);
    reconstruct(&model(config, arithmetic), &images(golden), &options).to_scene().unwrap()
}

#[test]
fn every_arithmetic_gives_the_same_pictures() {
    let mut renderer = Renderer::new(device());
    let mut cameras = [camera(96, 96), camera(96, 96)];
    cameras[1].pose.translation.z = -4.0;
    for config in ["micro.v2", "tiny.v3", "tiny_swiglu.v3", "small.v2"] {
        let Some(golden) = Golden::open(&format!("{config}.safetensors")) else { continue };
        let network = config.split('.').next().expect("network.case");
        let exact = scene_of(&golden, network, Arithmetic::EXACT);
        let truth = renderer.render_scene(&exact, &cameras, &RenderOptions::default()).unwrap();
        for arithmetic in fast_arithmetics() {
            let scene = scene_of(&golden, network, arithmetic);
            let frames = renderer.render_scene(&scene, &cameras, &RenderOptions::default()).unwrap();
            for (view, (frame, truth)) in frames.iter().zip(&truth).enumerate() {
                let (rgb, truth) = (frame.rgb.as_ref().unwrap(), truth.rgb.as_ref().unwrap());
                assert!(truth.iter().any(|x| *x > 0.1), "{config} {view}: nothing to see");
                let picture = Picture { values: rgb, width: 96, channels: 3 };
                let name = format!("{config} {view} {arithmetic:?}");
                let psnr = assert_images_close(&name, picture, truth, &[], ImageTolerance::of_network(arithmetic));
                println!("{name}: {psnr:.1} dB");
            }
        }
    }
}
