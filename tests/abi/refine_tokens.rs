use crate::{
    calls::*,
    refine::{Place, place},
};
use std::ops::ControlFlow;
use zipsplat::{
    reconstruct::{Model, ReconstructOptions},
    refine::{FrozenHead, RefineLength, RefineOptions, refine_tokens},
    types::{Camera, Scene},
};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{compare::assert_same, device::device as rust_device, scenes::camera};

fn model_with_tokens(device: &Object<zs_device>) -> Object<zs_model> {
    let precision = zs_precision::ZS_PRECISION_FP32 as i32;
    made(try_model_with(device, &zs_model_options { precision, tokens: 1, ..Versioned::new() }))
}

#[test]
fn tokens_are_refined_as_in_rust() {
    let (device, photos) = (open_device(), photos(2));
    let model = model_with_tokens(&device);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let go_on = |_: zipsplat::gpu::Progress<'_>| ControlFlow::Continue(());
    for (world, away) in [(zs_world::ZS_WORLD_FIRST_CAMERA, 0.0), (zs_world::ZS_WORLD_INPUT_CAMERAS, 2.0)] {
        let cameras: Vec<Camera> = (0..2)
            .map(|i| {
                let mut camera = camera(SIDE, SIDE);
                camera.pose.translation.x = away + 0.05 * f64::from(i);
                camera
            })
            .collect();
        let place = Place { cameras: cameras.clone(), photos: photos.clone(), moved: Scene::default() };
        let c_cameras = place.c_cameras();
        let making = zs_reconstruct_options {
            world: world as i32,
            camera_count: 2,
            cameras: c_cameras.as_ptr(),
            ..reconstruct_options()
        };
        let scene = made(try_reconstruct(&model, &images, &making));
        let options = zs_refine_options {
            steps: 6,
            target: zs_refine_target::ZS_REFINE_TARGET_TOKENS as i32,
            ..Versioned::new()
        };
        let mut info = zs_refine_result::new();
        let refine = |out| unsafe {
            zs_refine_reconstruction(scene.handle, images.as_ptr(), c_cameras.as_ptr(), 2, &options, &mut info, out)
        };
        let refined = read(&made(Object::try_new(refine)));
        assert_ne!(bits(&refined), bits(&read(&to_scene(&scene))));

        let network =
            Model::from_checkpoint(rust_device(), &checkpoint(), |_| ControlFlow::Continue(())).expect("a model");
        let first = cameras[0].pose;
        let relative: Vec<Camera> = cameras.iter().map(|camera| camera.relative_to(&first)).collect();
        let request = ReconstructOptions { cameras: Some(relative.clone()), ..ReconstructOptions::default() };
        let features = network.features(&photos, &request, go_on).expect("features");
        let tokens = network.tokens(&features, &request, go_on).expect("tokens");
        let head = FrozenHead::load(rust_device(), &checkpoint()).expect("a head");
        let request = RefineOptions {
            length: RefineLength::Steps(6),
            max_image_size: Some([1600; 2]),
            ..RefineOptions::default()
        };
        let never = |_: zipsplat::refine::RefineProgress| ControlFlow::Continue(());
        let mut expected =
            refine_tokens(network.arena(), &head, &tokens, &photos, &relative, &request, never).expect("a scene");
        assert!(info.steps == 6 && info.final_loss == f64::from(expected.losses[5]), "{} steps", info.steps);
        if away > 0.0 {
            expected.scene.place(1.0, &first);
        }
        assert_same("scene", &bits(&refined), &bits(&expected.scene));
    }
    let tokens = zs_refine_target::ZS_REFINE_TARGET_TOKENS as i32;
    let place = place(2);
    let refused = |options: zs_refine_options, words: &[&str]| {
        let status = place.in_c(&options).map(drop).expect_err("it is refused");
        fails(status, ZS_ERROR_ARGUMENT, words);
    };
    refused(
        zs_refine_options { target: tokens, ..Versioned::new() },
        &["target of a scene", "zs_refine_reconstruction"],
    );
    refused(zs_refine_options { target: 2, ..Versioned::new() }, &["target", "zs_refine_target"]);
    refused(zs_refine_options { exposure: 3, ..Versioned::new() }, &["exposure", "zs_exposure_mode"]);
    for (options, word) in [
        (zs_model_options { tokens: 2, ..Versioned::new() }, "tokens"),
        (zs_model_options { reserved: 1, ..Versioned::new() }, "reserved"),
    ] {
        fails(try_model_with(&device, &options).map(drop).expect_err("it is refused"), ZS_ERROR_ARGUMENT, &[word]);
    }
}
