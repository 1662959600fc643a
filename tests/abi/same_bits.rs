use crate::calls::*;
use glam::{DMat3, DVec3};
use std::{
    ops::ControlFlow::{self, Continue},
    ptr::null,
};
use zipsplat::{
    ops::{Arithmetic, Precision},
    reconstruct::{Model, Ratio, ReconstructOptions, TokenSelection},
    stages::render::{Depth, RenderOptions, RenderOutput, Renderer},
    tune::KernelChoice,
    types::{Camera, Image, Intrinsics, PointCloud, Pose, Scene},
    weights::{Checkpoint, Dtype},
};
use zipsplat_c::{zs_status::*, *};
use zipsplat_tests::{compare::assert_same, device::device as rust_device, scenes::scene_extensions};

/// Returns bytes, row stride, and offset of the top row.
fn encode(photo: &Image, format: zs_pixel_format, padding: usize, bottom_up: bool) -> (Vec<u8>, i64, usize) {
    let mut rows: Vec<Vec<u8>> = Vec::new();
    for row in photo.rgb.chunks_exact(3 * photo.width as usize) {
        let floats = |p: &[u8]| p.iter().flat_map(|v| (f32::from(*v) / 255.0).to_ne_bytes()).collect::<Vec<u8>>();
        let pixel = |p: &[u8]| match format {
            zs_pixel_format::ZS_PIXEL_RGB8 => p.to_vec(),
            zs_pixel_format::ZS_PIXEL_RGBA8 => vec![p[0], p[1], p[2], 77],
            zs_pixel_format::ZS_PIXEL_BGRA8 => vec![p[2], p[1], p[0], 77],
            zs_pixel_format::ZS_PIXEL_RGB_F32 => floats(p),
            zs_pixel_format::ZS_PIXEL_RGBA_F32 => [floats(p), 0.5f32.to_ne_bytes().to_vec()].concat(),
        };
        rows.push(row.chunks_exact(3).flat_map(pixel).chain(std::iter::repeat_n(99, padding)).collect());
    }
    let stride = rows[0].len() as i64;
    if bottom_up {
        rows.reverse();
    }
    let start = if bottom_up { (rows.len() - 1) * stride as usize } else { 0 };
    (rows.concat(), if bottom_up { -stride } else { stride }, start)
}

#[test]
fn photos_of_every_format_give_rusts_scene() {
    let photos = photos(2);
    let request = ReconstructOptions { ratio: Ratio::Fixed(0.5), ..ReconstructOptions::default() };
    let expected = bits(&rust_scene(&checkpoint(), &photos, &request));
    let device = open_device();
    let model = model(&device);
    let options = zs_reconstruct_options { ratio: 0.5, ..reconstruct_options() };
    let formats = [
        (zs_pixel_format::ZS_PIXEL_RGB8, 0, false),
        (zs_pixel_format::ZS_PIXEL_RGBA8, 3, false),
        (zs_pixel_format::ZS_PIXEL_BGRA8, 64, true),
        (zs_pixel_format::ZS_PIXEL_RGB_F32, 1, false),
        (zs_pixel_format::ZS_PIXEL_RGBA_F32, 0, true),
    ];
    for (format, padding, bottom_up) in formats {
        let encoded: Vec<_> = photos.iter().map(|photo| encode(photo, format, padding, bottom_up)).collect();
        let image = |(bytes, stride, start): &(Vec<u8>, i64, usize)| zs_image {
            pixels: bytes[*start..].as_ptr().cast(),
            stride: *stride,
            format: format as i32,
            ..image_of(&photos[0])
        };
        let images: Vec<_> = encoded.iter().map(image).collect();
        assert_same(&format!("{format:?}"), &bits(&read(&reconstruct(&model, &images, &options))), &expected);
    }
}

#[test]
fn options_and_cameras_give_rusts_scene() {
    let photos = photos(3);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let device = open_device();
    let model = model(&device);
    let cameras: Vec<Camera> = (0..3)
        .map(|i| Camera {
            intrinsics: Intrinsics::from_fov(SIDE, SIDE, 1.0, 1.0),
            pose: Pose {
                rotation: DMat3::from_rotation_y(0.2 * f64::from(i + 1)),
                translation: DVec3::new(0.1 * f64::from(i), 0.0, 0.05),
            },
        })
        .collect();
    let c_cameras: Vec<_> = cameras.iter().map(in_c).collect();
    let relative: Vec<_> = cameras.iter().map(|camera| camera.relative_to(&cameras[0].pose)).collect();
    let cases = [
        (ZS_RATIO_AUTO, Ratio::Auto, zs_token_selection::ZS_TOKEN_SELECTION_KMEANS, TokenSelection::KMEANS, false),
        (0.3, Ratio::Fixed(0.3), zs_token_selection::ZS_TOKEN_SELECTION_STRIDE, TokenSelection::Stride, true),
        (0.3, Ratio::Fixed(0.3), zs_token_selection::ZS_TOKEN_SELECTION_RANDOM, TokenSelection::Random(7), false),
        (0.3, Ratio::Fixed(0.3), zs_token_selection::ZS_TOKEN_SELECTION_MUTUAL, TokenSelection::MutualNearest, true),
        (1.0, Ratio::Fixed(1.0), zs_token_selection::ZS_TOKEN_SELECTION_KMEANS, TokenSelection::KMEANS, true),
    ];
    for (number, ratio, choice, selection, posed) in cases {
        let mut options =
            zs_reconstruct_options { ratio: number, token_selection: choice as i32, seed: 7, ..reconstruct_options() };
        if posed {
            (options.cameras, options.camera_count, options.kv_pool) = (c_cameras.as_ptr(), 3, c"2+own".as_ptr());
        }
        let (cameras, pool) = if posed { (Some(relative.clone()), "2+own") } else { (None, "1") };
        let request = ReconstructOptions {
            ratio,
            token_selection: selection,
            cameras,
            scene_scale: Some(1.0),
            kv_pool: pool.parse().unwrap(),
            ..ReconstructOptions::default()
        };
        let expected = bits(&rust_scene(&checkpoint(), &photos, &request));
        assert_same(&format!("{request:?}"), &bits(&read(&reconstruct(&model, &images, &options))), &expected);
    }
    // Scales by an exact power of two.
    let mut far: Vec<_> = c_cameras.clone();
    far.iter_mut().flat_map(|camera| &mut camera.translation).for_each(|x| *x *= 4.0);
    let options = |cameras: &[zs_camera], scene_scale| zs_reconstruct_options {
        cameras: cameras.as_ptr(),
        camera_count: 3,
        scene_scale,
        ..reconstruct_options()
    };
    let mut expected = read(&reconstruct(&model, &images, &options(&c_cameras, 1.0)));
    expected.scale(4.0);
    assert_same("scene scale", &bits(&read(&reconstruct(&model, &images, &options(&far, 4.0)))), &bits(&expected));
    let first = cameras[0].pose;
    expected.place(1.0, &Pose { translation: 4.0 * first.translation, ..first });
    let own = zs_reconstruct_options { world: zs_world::ZS_WORLD_INPUT_CAMERAS as i32, ..options(&far, 4.0) };
    assert_same("world", &bits(&read(&reconstruct(&model, &images, &own))), &bits(&expected));
}

pub fn rust_camera(camera: &zs_camera) -> Camera {
    let zs_camera { width, height, fx, fy, cx, cy, translation, .. } = *camera;
    let pose = Pose { rotation: DMat3::IDENTITY, translation: DVec3::from_array(translation) };
    Camera { intrinsics: Intrinsics { width, height, fx, fy, cx, cy }, pose }
}

fn pixels(frame: &RenderOutput, format: zs_pixel_format) -> Vec<u8> {
    let (rgb, alpha) = (frame.rgb.as_ref().unwrap(), frame.alpha.as_ref().unwrap());
    let byte = |value: f32| Image::from_rgb_f32(1, 1, &[value; 3]).unwrap().rgb[0];
    let nearest_byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round_ties_even() as u8;
    let words = |values: &[f32]| values.iter().flat_map(|v| v.to_ne_bytes()).collect::<Vec<u8>>();
    let pixel = |(c, a): (&[f32], &f32)| match format {
        zs_pixel_format::ZS_PIXEL_RGB8 => [c[0], c[1], c[2]].map(byte).to_vec(),
        zs_pixel_format::ZS_PIXEL_RGBA8 => vec![byte(c[0]), byte(c[1]), byte(c[2]), nearest_byte(*a)],
        zs_pixel_format::ZS_PIXEL_BGRA8 => vec![byte(c[2]), byte(c[1]), byte(c[0]), nearest_byte(*a)],
        zs_pixel_format::ZS_PIXEL_RGB_F32 => words(c),
        zs_pixel_format::ZS_PIXEL_RGBA_F32 => words(&[c[0], c[1], c[2], *a]),
    };
    rgb.chunks_exact(3).zip(alpha).flat_map(pixel).collect()
}

#[test]
fn pictures_are_rusts() {
    let device = open_device();
    let photos = photos(2);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let scene = reconstruct(&model(&device), &images, &reconstruct_options());
    let renderer = renderer(&device, &scene);
    let cameras = [camera(64, 48, 0.0), camera(40, 33, 0.1), camera(64, 48, 0.2)];
    let background = [0.1, 0.5, 0.9];
    let request = RenderOptions { alpha: true, depth: Some(Depth::Expected), background, ..RenderOptions::default() };
    let frames = Renderer::new(rust_device())
        .render_scene(&read(&scene), &cameras.each_ref().map(rust_camera), &request)
        .unwrap();
    let formats = [
        (zs_pixel_format::ZS_PIXEL_RGB8, 3),
        (zs_pixel_format::ZS_PIXEL_RGBA8, 4),
        (zs_pixel_format::ZS_PIXEL_BGRA8, 4),
        (zs_pixel_format::ZS_PIXEL_RGB_F32, 12),
        (zs_pixel_format::ZS_PIXEL_RGBA_F32, 16),
    ];
    for (format, bytes) in formats {
        let options = zs_render_options { background, ..render_options(format) };
        for (camera, frame) in cameras.iter().zip(&frames) {
            assert_same(&format!("{format:?}"), &draw(&renderer, camera, &options, bytes), &pixels(frame, format));
        }
    }
    let mut memory: Vec<_> = cameras
        .map(|c| {
            let count = (c.width * c.height) as usize;
            (vec![9u8; count * 3 + c.height as usize * 5], vec![0.0f32; count], vec![0.0f32; count])
        })
        .into();
    let pictures: Vec<_> = cameras
        .iter()
        .zip(&mut memory)
        .map(|(camera, (pixels, alpha, depth))| {
            let row = 3 * camera.width as usize + 5;
            let top = (camera.height as usize - 1) * row;
            let pixels = pixels[top..].as_mut_ptr();
            let (alpha, depth) = (alpha.as_mut_ptr(), depth.as_mut_ptr());
            zs_render_buffers { stride: -(row as i64), alpha, depth, ..picture_at(pixels) }
        })
        .collect();
    let options = zs_render_options { background, ..render_options(zs_pixel_format::ZS_PIXEL_RGB8) };
    ok(unsafe { zs_render(renderer.handle, cameras.as_ptr(), pictures.as_ptr(), 3, &options) });
    for ((camera, frame), (found, alpha, depth)) in cameras.iter().zip(&frames).zip(&memory) {
        let row = 3 * camera.width as usize;
        let rows: Vec<_> = found.chunks_exact(row + 5).rev().flat_map(|r| r[..row].to_vec()).collect();
        assert!(found.chunks_exact(row + 5).all(|r| r[row..] == [9; 5]), "between rows");
        assert_same("pixels", &rows, &pixels(frame, zs_pixel_format::ZS_PIXEL_RGB8));
        assert_same("alpha", alpha, frame.alpha.as_ref().unwrap());
        assert_same("depth", depth, frame.depth.as_ref().unwrap());
    }
}

#[test]
fn scenes_come_back_from_arrays_and_files() {
    let device = open_device();
    let photos = photos(1);
    let scene = reconstruct(&model(&device), &[image_of(&photos[0])], &reconstruct_options());
    let gaussians = read(&scene);
    let array = arrays(&gaussians);
    let copy = Object::new(|out| unsafe { zs_scene_create(&array, out) });
    assert_same("copied", &bits(&read(&copy)), &bits(&gaussians));
    let folder = tempfile::tempdir().unwrap();
    for extension in scene_extensions() {
        let path = folder.path().join(format!("scene.{extension}"));
        let text = c_string(path.to_str().unwrap());
        ok(unsafe { zs_scene_save(scene.handle, text.as_ptr(), null()) });
        let back = Object::new(|out| unsafe { zs_scene_open(text.as_ptr(), null(), out) });
        assert_same(extension, &bits(&read(&back)), &bits(&zipsplat::types::Scene::open(&path).unwrap()));
    }
}

#[test]
fn gaussians_that_are_no_numbers_are_dropped_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.splat");
    let row = |x: f32| {
        let floats = [x, 0.0, 1.0, 0.1, 0.1, 0.1].map(f32::to_le_bytes);
        [floats.as_flattened(), &[9; 8]].concat()
    };
    std::fs::write(&path, [row(1.0), row(f32::NAN), row(2.0), row(f32::INFINITY)].concat()).unwrap();
    let text = c_string(path.to_str().unwrap());
    let open = |out| unsafe { zs_scene_open(text.as_ptr(), null(), out) };
    refused(Object::try_new(open), zs_status::ZS_ERROR_FORMAT, &["scene.splat", "2 of 4"]);
    let scene = made(open_scene(&path, &zs_scene_open_options { drop_invalid: 1, ..Versioned::new() }));
    assert_eq!(read(&scene).means, [[1.0, 0.0, 1.0], [2.0, 0.0, 1.0]]);
    let mut info = zs_scene_info::new();
    ok(unsafe { zs_scene_get_info(scene.handle, &mut info) });
    assert_eq!((info.dropped_count, info.gaussian_count, info.world), (2, 2, zs_world::ZS_WORLD_AUTO as i32));
}

#[test]
fn a_model_computes_in_the_precision_that_was_asked_for() {
    let device = open_device();
    let photos = photos(2);
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let limits = rust_device().limits();
    let has = |precision| Arithmetic::of(precision, limits).map(|_| precision);
    let best = Precision::best(limits);
    for (asked, expected) in [
        (zs_precision::ZS_PRECISION_AUTO, Some(best)),
        (zs_precision::ZS_PRECISION_FP32, Some(Precision::Fp32)),
        (zs_precision::ZS_PRECISION_FP16, has(Precision::Fp16)),
        (zs_precision::ZS_PRECISION_BF16, has(Precision::Bf16)),
        (zs_precision::ZS_PRECISION_INT8, has(Precision::Int8)),
    ] {
        let model = try_model_with(&device, &zs_model_options { precision: asked as i32, ..Versioned::new() });
        let Some(expected) = expected else {
            assert_eq!(model.err(), Some(zs_status::ZS_ERROR_ARGUMENT), "{asked:?}");
            continue;
        };
        let model = made(model);
        let mut info = zs_model_info::new();
        ok(unsafe { zs_model_get_info(model.handle, &mut info) });
        let code = if asked == zs_precision::ZS_PRECISION_AUTO { 1 + best as i32 } else { asked as i32 };
        assert_eq!(info.precision, code, "{asked:?}");
        let arithmetic = KernelChoice::of(rust_device(), Some(expected)).expect("the device has it").arithmetic;
        let ours = Model::from_checkpoint_with(rust_device(), &checkpoint(), arithmetic, |_| ControlFlow::Continue(()))
            .unwrap();
        let ours = ours
            .reconstruct_views(&photos, &ReconstructOptions::default(), |_| ControlFlow::Continue(()))
            .unwrap()
            .to_scene()
            .unwrap();
        let from_c = reconstruct(&model, &images, &reconstruct_options());
        assert_same(&format!("{asked:?}"), &bits(&read(&from_c)), &bits(&ours));
    }
}

#[test]
fn weights_of_8_bits_come_from_memory() {
    let (device, photos, bytes) = (open_device(), photos(2), micro_in(Dtype::Q8));
    let options = zs_model_options { precision: zs_precision::ZS_PRECISION_FP32 as i32, ..Versioned::new() };
    let model = made(model_from(&device, &bytes, &options));
    let from_c = reconstruct(&model, &photos.iter().map(image_of).collect::<Vec<_>>(), &reconstruct_options());
    let checkpoint = Checkpoint::from_bytes("q8", bytes.clone(), None).expect("what was just written");
    let ours = rust_scene(&checkpoint, &photos, &ReconstructOptions::default());
    assert_same("q8", &bits(&read(&from_c)), &bits(&ours));
    if Arithmetic::of(Precision::Int8, rust_device().limits()).is_some() {
        let int8 = zs_model_options { precision: zs_precision::ZS_PRECISION_INT8 as i32, ..options };
        refused(model_from(&device, &bytes, &int8), zs_status::ZS_ERROR_ARGUMENT, &["precision", "q8", "fp16"]);
    }
}

#[test]
fn reconstructions_and_updated_arrays_are_drawn_as_their_scenes() {
    let (device, photos) = (open_device(), photos(2));
    let images: Vec<_> = photos.iter().map(image_of).collect();
    let reconstruction = made(try_reconstruct(&model(&device), &images, &reconstruct_options()));
    let scene = to_scene(&reconstruction);
    let options = render_options(zs_pixel_format::ZS_PIXEL_RGB_F32);
    let picture = |renderer: &Object<zs_renderer>| draw(renderer, &camera(40, 30, 0.1), &options, 12);
    let expected = picture(&renderer(&device, &scene));
    let other = Object::new(|out| unsafe { zs_renderer_create(device.handle, null(), out) });
    let status = try_draw(&other, &camera(40, 30, 0.1), &options, 12).expect_err("there is no scene");
    fails(status, zs_status::ZS_ERROR_ARGUMENT, &["scene"]);
    ok(unsafe { zs_renderer_set_reconstruction(other.handle, reconstruction.handle) });
    assert_same("reconstruction", &picture(&other), &expected);
    let mut gaussians = read(&scene);
    for step in 0..3 {
        gaussians.means.iter_mut().for_each(|mean| mean[0] += 0.01);
        ok(unsafe { zs_renderer_update_gaussians(other.handle, &arrays(&gaussians)) });
        let expected = picture(&renderer(&device, &scene_of(&gaussians)));
        assert_same(&format!("step {step}"), &picture(&other), &expected);
    }
    gaussians.opacities[0] = f32::NAN;
    let status = unsafe { zs_renderer_update_gaussians(other.handle, &arrays(&gaussians)) };
    fails(status, zs_status::ZS_ERROR_ARGUMENT, &["opacities"]);
}

#[test]
fn normals_and_point_scenes_are_rusts() {
    let device = open_device();
    let positions = [[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.2, 2.5f32]];
    let colors = [[255, 0, 0], [0, 255, 0], [0, 0, 255u8]];
    let view = camera(24, 16, 0.0);
    let from_points = |count, colors, cameras: &[zs_camera]| {
        let (positions, cameras, len) = (positions.as_ptr().cast(), cameras.as_ptr(), cameras.len());
        Object::try_new(|out| unsafe { zs_scene_from_points(positions, colors, count, cameras, len, out) })
    };
    let scene = made(from_points(3, colors.as_ptr().cast(), &[view]));
    let mut cloud = PointCloud { positions: positions.to_vec(), colors: colors.to_vec() };
    let expected = Scene::from_points(&cloud, &[rust_camera(&view)]).expect("a scene");
    assert_same("points", &bits(&read(&scene)), &bits(&expected));
    cloud.colors.clear();
    let gray = Scene::from_points(&cloud, &[]).expect("a scene");
    assert_same("gray points", &bits(&read(&made(from_points(3, null(), &[])))), &bits(&gray));
    for count in [0, 1] {
        assert_eq!(from_points(count, null(), &[]).err(), Some(zs_status::ZS_ERROR_ARGUMENT));
    }
    let mut normals = vec![7.0; 3 * 24 * 16];
    let buffers = zs_render_buffers { normals: normals.as_mut_ptr(), ..Versioned::new() };
    ok(unsafe { zs_render(renderer(&device, &scene).handle, &view, &buffers, 1, null()) });
    let options = RenderOptions { rgb: false, normals: true, ..RenderOptions::default() };
    let truth = Renderer::new(rust_device()).render_scene(&expected, &[rust_camera(&view)], &options).unwrap();
    assert_same("normals", &normals, truth[0].normals.as_ref().unwrap());
}

#[test]
fn kept_features_give_other_scenes_and_patch_tokens() {
    let (device, photos) = (open_device(), photos(2));
    let (model, images) = (model(&device), photos.iter().map(image_of).collect::<Vec<_>>());
    let keeping = zs_reconstruct_options { keep_features: 1, ..reconstruct_options() };
    let whole = made(try_reconstruct(&model, &images, &keeping));
    let stride = zs_token_selection::ZS_TOKEN_SELECTION_STRIDE as i32;
    let half = zs_reconstruct_options { ratio: 0.5, token_selection: stride, ..reconstruct_options() };
    let again = |model: &Object<zs_model>, from: &Object<zs_reconstruction>| {
        let make = |out| unsafe { zs_reconstruct_again(model.handle, from.handle, &half, out) };
        Object::try_new(make)
    };
    let found = made(again(&model, &whole));
    let expected = reconstruct(&model, &images, &half);
    assert_eq!(bits(&read(&to_scene(&found))), bits(&read(&expected)));
    assert_eq!(bits(&read(&to_scene(&whole))), bits(&read(&reconstruct(&model, &images, &reconstruct_options()))));
    assert_eq!(bits(&read(&to_scene(&made(again(&model, &found))))), bits(&read(&expected)));

    let rust = Model::from_checkpoint(rust_device(), &checkpoint(), |_| Continue(())).expect("a model");
    let options = ReconstructOptions { scene_scale: Some(1.0), ..ReconstructOptions::default() };
    let features = rust.features(&photos, &options, |_| Continue(())).expect("features");
    let (mut info, mut values) = (zs_reconstruction_info::new(), zs_pixel_values::new());
    ok(unsafe { zs_reconstruction_get_info(whole.handle, &mut info) });
    assert_eq!(info.channel_count, features.channels());
    for (i, tokens) in features.patch_tokens().expect("tokens").into_iter().enumerate() {
        ok(unsafe { zs_reconstruction_get_patch_tokens(whole.handle, i, &mut values) });
        assert_eq!([values.width, values.height], [SIDE / 14; 2]);
        let found = unsafe { std::slice::from_raw_parts(values.values, tokens.values.len()) };
        assert!(found == tokens.values && tokens.values.iter().any(|value| *value != 0.0));
    }
    let beyond = unsafe { zs_reconstruction_get_patch_tokens(whole.handle, 2, &mut values) };
    fails(beyond, ZS_ERROR_ARGUMENT, &["number of a photo", "2"]);
    let without = made(try_reconstruct(&model, &images, &reconstruct_options()));
    refused(again(&model, &without), ZS_ERROR_ARGUMENT, &["without features", "keep_features"]);
    let other = self::model(&device);
    refused(again(&other, &whole), ZS_ERROR_ARGUMENT, &["model", "another"]);
    let wrong = zs_reconstruct_options { keep_features: 2, ..reconstruct_options() };
    refused(try_reconstruct(&model, &images, &wrong), ZS_ERROR_ARGUMENT, &["keep_features", "2"]);
}
