use zipsplat::depth::{DepthMap, DepthPrediction, add_view};
use zipsplat::{features::PixelValues, gpu::StageTimes};
use zipsplat_tests::prelude::*;

/// Two views of 2 x 1 patches of 2 x 2 pixels.
const SIZE: [u32; 2] = [4, 2];
const PIXELS: usize = 8;

fn depths(of: impl Fn(usize) -> DepthMap) -> DepthPrediction {
    let views = (0..2).map(of).collect();
    let times = StageTimes::default();
    let ([width, height], patches, patch_tokens) = (SIZE, None, Vec::new());
    DepthPrediction { width, height, views, patch_size: 2, patches, patch_tokens, times, peak_bytes: 0 }
}

fn view(depth: impl Fn(usize) -> f32) -> DepthMap {
    let depth = (0..PIXELS).map(depth).collect();
    DepthMap { depth, ..DepthMap::default() }
}

fn cameras() -> [Camera; 2] {
    let intrinsics = Intrinsics { width: SIZE[0], height: SIZE[1], fx: 3.0, fy: 2.5, cx: 2.25, cy: 0.75 };
    let rotation = DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(-0.2);
    let pose = Pose { rotation, translation: DVec3::new(0.5, -1.0, 2.0) };
    [Camera { intrinsics, pose: Pose::IDENTITY }, Camera { intrinsics, pose }]
}

fn images() -> [Image; 2] {
    [0, 100].map(|first| Image::new(SIZE[0], SIZE[1], (0..3 * PIXELS as u8).map(|i| first + 4 * i).collect()).unwrap())
}

fn pixel(camera: &Camera, mean: [f32; 3]) -> (usize, f64) {
    let at = camera.pose.inverse().transform(mean.map(f64::from).into());
    let lens = camera.intrinsics;
    let (x, y) = (lens.fx * at.x / at.z + lens.cx, lens.fy * at.y / at.z + lens.cy);
    assert!((x.fract() - 0.5).abs() < 1e-5 && (y.fract() - 0.5).abs() < 1e-5, "{x} {y} is no middle of a pixel");
    (y as usize * SIZE[0] as usize + x as usize, at.z)
}

/// From depths `10 view + pixel + 1`.
fn pixels(scene: &Scene) -> Vec<usize> {
    let place = |mean: &[f32; 3]| {
        let found = cameras().iter().enumerate().find_map(|(view, camera)| {
            let z = camera.pose.inverse().transform(mean.map(f64::from).into()).z;
            let whole = (z - z.round()).abs() < 1e-4 && (z.round() as usize) / 10 == view;
            whole.then(|| (10 * view, pixel(camera, *mean)))
        });
        let (view, (pixel, z)) = found.expect("a depth of some view");
        assert_eq!(z.round() as usize, view + pixel + 1);
        view + pixel
    };
    scene.means.iter().map(place).collect()
}

fn numbered() -> DepthPrediction {
    depths(|v| view(move |i| (10 * v + i + 1) as f32))
}

#[test]
fn each_pixel_is_where_its_depth_has_it() {
    let scene = numbered().scene(&cameras(), &images(), None);
    assert_eq!(pixels(&scene), [0, 1, 4, 5, 2, 3, 6, 7, 10, 11, 14, 15, 12, 13, 16, 17]);
    scene.validate().unwrap();
    // As wide as a pixel at its depth.
    let mut given = Scene::default();
    add_view(&mut given, &cameras()[0], &images()[0], &numbered().views[0].depth);
    assert!((given.scales[4][0] - 0.6 * 5.0 / 3.0).abs() < 1e-6 && given.opacities.iter().all(|o| *o == 0.95));
    let order = [0, 1, 4, 5, 2, 3, 6, 7];
    given.keep(&order);
    assert_eq!(scene.means[..8], given.means[..]);
    assert_eq!((&scene.scales[..8], &scene.sh_coeffs[..8]), (&given.scales[..], &given.sh_coeffs[..]));
    assert_ne!(scene.sh_coeffs[0], scene.sh_coeffs[1]);
}

#[test]
fn sky_and_what_has_no_depth_are_left_out() {
    let mut depths = numbered();
    depths.views[0].depth[1] = f32::INFINITY;
    depths.views[0].depth[2] = 0.0;
    depths.views[1].sky = Some([0.0, 0.31, 0.29, 0.0, 0.5, 0.0, 0.0, 0.0].into());
    let scene = depths.scene(&cameras(), &images(), None);
    assert_eq!(pixels(&scene), [0, 4, 5, 3, 6, 7, 10, 15, 12, 13, 16, 17]);
    // NaN pixels displace no others of their patch.
    depths.views[1].depth[1] = f32::NAN;
    let kept = depths.scene(&cameras(), &images(), Some(2));
    assert_eq!(pixels(&kept), [4, 5, 6, 7, 10, 15, 16, 17]);
}

#[test]
fn opacity_follows_confidence() {
    let mut depths = numbered();
    // Percentiles 40 to 90 bound 1.05, here 1.2; above, pixels are opaque.
    let sure = [1.0, 1.01, 1.1, 1.2, 1.2, 1.2, 1.3, 9.0];
    depths.views.iter_mut().for_each(|view| view.confidence = Some(sure.into()));
    let scene = depths.scene(&cameras(), &images(), None);
    assert_eq!(pixels(&scene), [4, 5, 2, 3, 6, 7, 14, 15, 12, 13, 16, 17]);
    let expected = [0.95, 0.95, 0.475, 0.95, 0.95, 0.95];
    for (found, expected) in scene.opacities.iter().zip(expected.iter().cycle()) {
        assert!((found - expected).abs() < 1e-4, "{:?}", scene.opacities);
    }
}

#[test]
fn chosen_patches_stand_for_all() {
    let mut depths = numbered();
    depths.patches = Some(vec![1, 2]);
    let tokens = |value: f32| PixelValues { width: 2, height: 1, channels: 1, values: vec![value; 2] };
    depths.patch_tokens = vec![tokens(1.0), tokens(2.0)];
    assert_eq!(pixels(&depths.scene(&cameras(), &images(), None)), [2, 3, 6, 7, 10, 11, 14, 15]);
    depths.keep_views(&[false, true]);
    assert_eq!((depths.views.len(), &depths.patches), (1, &Some(vec![0])));
    assert_eq!(depths.patch_tokens, [tokens(2.0)]);
    let scene = depths.scene(&cameras()[1..], &images()[1..], None);
    assert_eq!(pixels(&scene), [10, 11, 14, 15]);
}

#[test]
fn depth_offsets_of_gaussians_scale_with_depth() {
    // Offsets of the second half put Gaussians at or behind the camera.
    let offset = |pixel: usize| [0.5, -4.0, -5.0, f32::NAN][pixel.saturating_sub(4)];
    let value = |i: usize| if i % 38 == 36 { offset(i / 38) } else { f32::from(u8::from((5..9).contains(&(i % 38)))) };
    let mut depths = depths(|v| DepthMap {
        encoding: Some([v as f32, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]),
        gaussians: Some((0..38 * PIXELS).map(value).collect()),
        ..view(|_| 4.0)
    });
    let known = [0.0, 10.0].map(|x| {
        let pose = Pose { translation: DVec3::new(x, 0.0, 0.0), ..Pose::IDENTITY };
        Camera { pose, ..cameras()[0] }
    });
    depths.align_to_cameras(&known).unwrap();
    let scene = depths.scene(&known, &images(), None);
    assert_eq!(scene.len(), 2 * 5);
    for (i, mean) in scene.means.iter().enumerate() {
        let distance = known[i / 5].pose.translation.distance(mean.map(f64::from).into());
        assert!((distance - 45.0).abs() < 1e-3, "Gaussian {i} is {distance} away");
    }
}

#[test]
fn depth_of_each_view_is_brought_to_points() {
    let truth = numbered();
    let points: Vec<[f32; 3]> = truth.scene(&cameras(), &images(), None).means;
    let mut depths = depths(|v| view(move |i| (10 * v + i + 1) as f32 * [0.5, 7.0][v]));
    depths.scale_to(&cameras(), &points).unwrap();
    for (found, truth) in depths.views.iter().zip(&truth.views) {
        assert!(found.depth.iter().zip(&truth.depth).all(|(a, b)| (a / b - 1.0).abs() < 1e-4), "{:?}", found.depth);
    }
    let behind = [[0.0, 0.0, -1.0]; 3];
    assert_eq!(depths.scale_to(&cameras()[..1], &behind), Err(0));
}
