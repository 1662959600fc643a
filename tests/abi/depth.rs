use crate::calls::*;
use std::{
    ops::ControlFlow::Continue,
    path::Path,
    ptr::{null, null_mut},
};
use zipsplat::{
    Camera,
    depth::{DepthModel, DepthOptions},
    ops::Arithmetic,
    types::Image,
    weights::{DepthCheckpoint, Dtype},
};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{architectures, device::device as rust_device};

fn model(device: &Object<zs_device>, folder: &Path, alone: bool) -> (DepthCheckpoint, Object<zs_depth_model>) {
    let network = if alone { architectures::depth_micro_alone() } else { architectures::depth_micro() };
    let checkpoint = DepthCheckpoint::seeded(network, "micro").expect("a network");
    let path = folder.join("micro.safetensors");
    checkpoint.save_with(&path, Dtype::F32, |_| Continue(())).expect("weights can be written");
    let path = c_string(path.to_str().expect("UTF-8"));
    let precision = zs_precision::ZS_PRECISION_FP32 as i32;
    let of_model = zs_depth_model_options { precision, ..Versioned::new() };
    let open = |out| unsafe { zs_depth_model_load(device.handle, path.as_ptr(), &of_model, out) };
    (checkpoint, Object::new(open))
}

fn find(model: &Object<zs_depth_model>, photos: &[Image], options: &zs_depth_options) -> Object<zs_depth_result> {
    let images: Vec<zs_image> = photos.iter().map(image_of).collect();
    Object::new(|out| unsafe { zs_depth_predict(model.handle, images.as_ptr(), images.len(), options, out) })
}

fn get(depths: &Object<zs_depth_result>, index: usize) -> (zs_depth_map, zs_camera) {
    let mut map = zs_depth_map::new();
    let camera = unsafe {
        ok(zs_depth_result_get_map(depths.handle, index, &mut map));
        map.image_camera.as_ref()
    };
    (map, camera.copied().unwrap_or_else(Versioned::new))
}

#[test]
fn depth_is_that_of_rust() {
    let (folder, device) = (tempfile::tempdir().expect("a folder"), open_device());
    let (checkpoint, model) = model(&device, folder.path(), false);
    let photos = photos(2);
    let own = zs_depth_options { input_size: SIDE, per_view_focal: 1, keep_features: 1, ..Versioned::new() };
    let depths = find(&model, &photos, &own);
    let rust =
        DepthModel::from_checkpoint(rust_device(), &checkpoint, Arithmetic::EXACT, |_| Continue(())).expect("a model");
    let truth = rust.predict(&photos, &DepthOptions::default(), |_| Continue(())).expect("depth");
    let cameras = truth.cameras().expect("a decoder");
    for (i, (of_view, camera)) in truth.views.iter().zip(&cameras).enumerate() {
        let (view, found) = get(&depths, i);
        assert_eq!((view.width, view.height, found.width), (SIDE, SIDE, SIDE));
        let [depth, confidence] = [view.depth, view.confidence]
            .map(|values| unsafe { std::slice::from_raw_parts(values, (SIDE * SIDE) as usize) });
        assert!(depth == of_view.depth && Some(confidence) == of_view.confidence.as_deref() && view.sky.is_null());
        assert_eq!((found.fx, found.cy), (camera.intrinsics.fx, camera.intrinsics.cy));
        assert_eq!(found.rotation, camera.pose.rotation.transpose().to_cols_array());
        assert_eq!(found.translation, camera.pose.translation.to_array());
    }
    let (mut info, mut of_model) = (zs_depth_result_info::new(), zs_depth_model_info::new());
    let of_map = unsafe {
        ok(zs_depth_result_get_info(depths.handle, &mut info));
        ok(zs_depth_model_get_info(model.handle, &mut of_model));
        *get(&depths, 1).0.camera
    };
    assert_eq!((of_map.fx, of_map.translation), (cameras[1].intrinsics.fx, cameras[1].pose.translation.to_array()));
    assert_eq!((info.view_count, of_model.is_multi_view, of_model.patch_size), (photos.len(), 1, 14));
    let tokens = rust.patch_tokens(&photos, &DepthOptions::default(), |_| Continue(())).expect("tokens");
    let mut values = zs_pixel_values::new();
    for (i, tokens) in tokens.iter().enumerate() {
        ok(unsafe { zs_depth_result_get_patch_tokens(depths.handle, i, &mut values) });
        let found = unsafe { std::slice::from_raw_parts(values.values, tokens.values.len()) };
        assert!(found == tokens.values && tokens.values.iter().any(|value| *value != 0.0));
    }
    assert_eq!((values.width, values.height, info.channel_count), (SIDE / 14, SIDE / 14, tokens[0].channels));
    assert_eq!((of_model.precision, of_model.weight_bytes), (1, rust.weight_bytes()));
    let shared = find(&model, &photos, &zs_depth_options { input_size: SIDE, ..Versioned::new() });
    let without = unsafe { zs_depth_result_get_patch_tokens(shared.handle, 0, &mut values) };
    fails(without, ZS_ERROR_ARGUMENT, &["without features", "keep_features"]);
    let lenses = [0, 1].map(|i| get(&shared, i).1).map(|camera| [camera.fx, camera.fy]);
    assert!(lenses[0] == lenses[1] && lenses[0][0] == lenses[0][1], "{lenses:?}");
    assert_ne!(lenses[0], [cameras[0].intrinsics.fx, cameras[0].intrinsics.fy]);

    let scene = Object::new(|out| unsafe { zs_depth_result_to_scene(depths.handle, 3, out) });
    let expected = truth.scene(&cameras, &photos, Some(3));
    assert!(expected.len() > 20);
    assert!(read(&scene) == expected);

    let given: Vec<zs_camera> = cameras
        .iter()
        .map(|camera: &Camera| {
            let mut camera = *camera;
            camera.pose.translation *= 10.0;
            zs_camera::from(&camera)
        })
        .collect();
    let known = zs_depth_options { input_size: SIDE, cameras: given.as_ptr(), camera_count: 2, ..Versioned::new() };
    let posed = find(&model, &photos, &known);
    assert_eq!(get(&posed, 1).1.translation, given[1].translation);
    let coincident = [given[0]; 2];
    let posed = find(&model, &photos, &zs_depth_options { cameras: coincident.as_ptr(), ..known });
    assert_eq!(get(&posed, 1).1.translation, given[0].translation);
}

#[test]
fn photos_by_themselves_have_sky_and_no_cameras() {
    let (folder, device) = (tempfile::tempdir().expect("a folder"), open_device());
    let (_, model) = model(&device, folder.path(), true);
    let depths = find(&model, &photos(1), &zs_depth_options { input_size: SIDE, ..Versioned::new() });
    let (view, camera) = get(&depths, 0);
    assert!(view.confidence.is_null() && !view.sky.is_null() && !view.depth.is_null());
    assert_eq!((camera.width, camera.height), (0, 0));
    assert!(view.camera.is_null());
    let status = unsafe { zs_depth_result_to_scene(depths.handle, 0, &mut null_mut()) };
    fails(status, ZS_ERROR_ARGUMENT, &["cameras of the depths", "none"]);
}

#[test]
fn wrong_arguments_are_named() {
    let (folder, device) = (tempfile::tempdir().expect("a folder"), open_device());
    let (_, model) = model(&device, folder.path(), false);
    let photos = photos(2);
    let images: Vec<zs_image> = photos.iter().map(image_of).collect();
    let camera = zs_camera::from(&zipsplat_tests::scenes::camera(SIDE, SIDE));
    for (options, words) in [
        (zs_depth_options { input_size: 13, ..Versioned::new() }, ["longest side", "13"]),
        (zs_depth_options { camera_source: 2, ..Versioned::new() }, ["camera_source", "zs_camera_source"]),
        (zs_depth_options { per_view_focal: 2, ..Versioned::new() }, ["per_view_focal", "0 or 1"]),
        (zs_depth_options { keep_features: 2, ..Versioned::new() }, ["keep_features", "0 or 1"]),
        (zs_depth_options { cameras: &camera, camera_count: 1, ..Versioned::new() }, ["number of cameras", "0 or 2"]),
    ] {
        let status = unsafe { zs_depth_predict(model.handle, images.as_ptr(), 2, &options, &mut null_mut()) };
        fails(status, ZS_ERROR_ARGUMENT, &words);
    }
    let depths = find(&model, &photos, &zs_depth_options { input_size: SIDE, ..Versioned::new() });
    unsafe {
        for status in [
            zs_depth_model_load(null(), null(), null(), null_mut()),
            zs_depth_predict(null(), null(), 0, null(), null_mut()),
            zs_depth_result_get_map(null(), 0, null_mut()),
            zs_depth_result_get_patch_tokens(null(), 0, null_mut()),
            zs_depth_result_get_info(null(), null_mut()),
            zs_depth_model_get_info(null(), null_mut()),
            zs_depth_result_to_scene(null(), 0, null_mut()),
        ] {
            fails(status, ZS_ERROR_ARGUMENT, &["NULL"]);
        }
        zs_depth_model_destroy(null_mut());
        zs_depth_result_destroy(null_mut());
        fails(
            zs_depth_result_get_map(depths.handle, 2, null_mut()),
            ZS_ERROR_ARGUMENT,
            &["number of a photo", "below 2"],
        );
        let path = c_string("seeded:vits");
        let status = zs_depth_model_load(device.handle, path.as_ptr(), null(), &mut null_mut());
        fails(status, ZS_ERROR_ARGUMENT, &["vits", "da3-small"]);
    }
}
