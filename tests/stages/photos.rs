use std::ops::ControlFlow::{Break, Continue};
use zipsplat::types::{
    poses::SceneScale,
    preprocess::{fit, view_cameras},
};
use zipsplat::{Camera, Image, Model, Pose, ReconstructOptions, RenderOptions, Renderer, SceneFrame};
use zipsplat_tests::{device::device, files::assert_refused};

const SIZE: [u32; 2] = [28, 42];

fn photo(seed: u32) -> Image {
    let rgb = (0..3 * 60 * 50).map(|i: u32| (i.wrapping_mul(seed + 7) >> 3) as u8).collect();
    Image::new(60, 50, rgb).expect("an image")
}

fn cameras() -> Vec<Camera> {
    let camera = |i: u32| {
        let pose = Pose { translation: [3.0 * f64::from(i), 0.5, -2.0].into(), ..Pose::IDENTITY };
        Camera { pose, ..Camera::from_hfov_deg(60, 50, 50.0) }
    };
    (0..2).map(camera).collect()
}

fn model() -> Model {
    Model::load(device(), "builtin").expect("a model")
}

#[test]
fn whole_photos_are_cropped_scaled_and_placed() {
    let (model, photos, cameras) = (model(), [photo(0), photo(1)], cameras());
    let options =
        ReconstructOptions { cameras: Some(cameras.clone()), input_size: Some(SIZE), ..ReconstructOptions::default() };
    let found = model.reconstruct(&photos, &options, |_| Continue(())).expect("a reconstruction");

    let views: Vec<_> = photos.iter().map(|photo| fit(photo, SIZE[0], SIZE[1]).expect("a view")).collect();
    let of_views = view_cameras(&cameras, &views).expect("cameras");
    let poses: Vec<Pose> = cameras.iter().map(|camera| camera.pose).collect();
    let scale = SceneScale::of(None, &poses, None, &of_views, &poses[0]).expect("a scale").length;
    let by_hand =
        ReconstructOptions { cameras: Some(of_views), scene_scale: Some(scale), ..ReconstructOptions::default() };
    let images: Vec<Image> = views.into_iter().map(|view| view.image).collect();
    let by_hand = model.reconstruct_views(&images, &by_hand, |_| Continue(())).expect("a reconstruction");
    let mut expected = by_hand.to_scene().expect("a scene");
    assert_ne!(scale, 1.0);
    let in_first = ReconstructOptions { world: Some(SceneFrame::FirstCamera), ..options };
    let view = |i: usize, [width, height]: [u32; 2]| fit(&photos[i], width, height);
    let prepared = model.prepare(2, &in_first, view, |_| Continue(())).expect("views");
    assert!(prepared.warning.is_some_and(|warning| warning.starts_with("no point cloud: scene scale 3.0000")));
    let first = model.reconstruct(&photos, &in_first, |_| Continue(())).expect("a reconstruction");
    assert_eq!(first.to_scene().expect("a scene"), expected);
    expected.place(1.0, &poses[0]);
    assert_eq!(found.to_scene().expect("a scene"), expected);

    let mut renderer = Renderer::new(device());
    let mut picture = |scene: &zipsplat::Reconstruction, camera: Camera| {
        renderer.set_scene(scene).expect("a scene");
        renderer.render(&[camera], &RenderOptions::default()).expect("pictures").remove(0).rgb.expect("color")
    };
    let [placed, on_device] = [(&found, cameras[0].pose), (&first, Pose::IDENTITY)]
        .map(|(scene, pose)| picture(scene, Camera { pose, ..Camera::from_hfov_deg(16, 16, 60.0) }));
    let deviation = placed.iter().zip(&on_device).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(deviation < 1e-3, "{deviation}");
}

#[test]
fn estimated_cameras_are_of_whole_photos() {
    let model = model();
    let options = ReconstructOptions { input_size: Some(SIZE), ..ReconstructOptions::default() };
    let found = model.reconstruct(&[photo(0)], &options, |_| Continue(())).expect("a reconstruction");
    let scene = found.to_scene().expect("a scene");
    let (whole, view) = (found.cameras(&scene, Some(40.0)), found.patches.cameras(&scene, Some(40.0)));
    let [whole, view] = [whole, view].map(|found| found.expect("estimates").remove(0).map(|found| found.camera));
    let (Ok(whole), Ok(view)) = (whole, view) else { panic!("no camera") };
    assert_eq!([whole.intrinsics.width, whole.intrinsics.height], [60, 50]);
    let map = found.placement.expect("photos").maps[0];
    assert_eq!(whole.intrinsics.fx, view.intrinsics.fx / map.scale[0]);
}

#[test]
fn unusable_options_are_refused_before_photos_are_opened() {
    let model = model();
    let refused = |options: ReconstructOptions, expected: &str| {
        let opened = model.prepare(2, &options, |_, _| unreachable!("checked first"), |_| Continue(()));
        assert_refused(opened, &[expected]);
    };
    let default = ReconstructOptions::default;
    refused(ReconstructOptions { world: Some(SceneFrame::InputCameras), ..default() }, "world: found input cameras");
    refused(ReconstructOptions { cameras: Some(cameras()[..1].to_vec()), ..default() }, "cameras: found 1, expected 2");
    refused(ReconstructOptions { input_size: Some([28, 30]), ..default() }, "multiples of 14");
    let cancelled = model.reconstruct(&[photo(0)], &default(), |_| Break(())).unwrap_err();
    assert!(matches!(cancelled, zipsplat::Error::Cancelled));
}
