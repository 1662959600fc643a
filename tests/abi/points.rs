use crate::{calls::*, same_bits::rust_camera};
use std::{ops::ControlFlow::Continue, ptr::null};
use zipsplat::{
    refine::stereo_points,
    types::{Image, PointCloud, Scene},
};
use zipsplat_c::*;
use zipsplat_tests::compare::assert_same;

#[test]
fn scenes_of_points_and_photos_are_rusts() {
    let (width, height, depth) = (80, 60, 2.0);
    let views = [0.0, 0.1, 0.2, 0.3].map(|x| camera(width, height, x));
    // A wall.
    let gray = |column: f64, row: f64| {
        let waves = [(0.5, 0.2), (-0.3, 0.6), (0.9, -0.4)];
        let sum: f64 = waves.iter().map(|(u, v)| (u * column + v * row).sin()).sum();
        [(128.0 + 40.0 * sum) as u8; 3]
    };
    let photo = |view: &zs_camera| {
        let moved = view.fx * view.translation[0] / depth;
        let at = |i: u32| gray(f64::from(i % width) + moved, f64::from(i / width));
        Image::new(width, height, (0..width * height).flat_map(at).collect()).expect("a photo")
    };
    let photos: Vec<Image> = views.iter().map(photo).collect();
    let positions: Vec<[f32; 3]> =
        (0..48).map(|i| [0.2 * (i % 8) as f32 - 0.6, 0.2 * (i / 8) as f32 - 0.5, depth as f32]).collect();
    let images: Vec<zs_image> = photos.iter().map(image_of).collect();
    let of_photos = |count, points| {
        let (images, cameras, positions) = (images.as_ptr(), views.as_ptr(), positions.as_ptr().cast());
        Object::try_new(|out| unsafe { zs_scene_from_photos(images, cameras, count, positions, null(), points, out) })
    };
    let cameras = views.each_ref().map(rust_camera);
    let cloud = PointCloud { positions: positions.clone(), colors: Vec::new() };
    let joined = stereo_points(&photos, &cameras, &cloud, None, |_| Continue(())).expect("points");
    assert!(joined.positions.len() > 100, "{}", joined.positions.len());
    let expected = Scene::from_points(&joined, &cameras).expect("a scene");
    assert_same("points of photos", &bits(&read(&made(of_photos(4, 48)))), &bits(&expected));
    assert_eq!(read(&made(of_photos(0, 48))).len(), 48);
    assert_eq!(of_photos(4, 0).err(), Some(zs_status::ZS_ERROR_ARGUMENT));
}
