use super::capture;
use std::{borrow::Cow, ops::ControlFlow};
use zipsplat::{
    Camera, Image, Result, Scene,
    gpu::Arena,
    refine::{DepthKind, DepthLoss, Photos, RefineLength, RefineOptions, RefineResult, refine_scene},
    stages::render::{Depth, RenderOptions, RenderOutput, Renderer},
    types::PointCloud,
};
use zipsplat_cli::{
    metrics::{psnr, values},
    procedural::{Capture, Options},
};
use zipsplat_tests::device::device;

fn options(side: u32) -> Options {
    Options { views: 12, width: side, height: side, supersample: true, random_first: false }
}

struct Known<'a> {
    capture: &'a Capture,
    views: Vec<usize>,
    depth: bool,
}

impl Photos for Known<'_> {
    fn count(&self) -> usize {
        self.views.len()
    }

    fn size(&self, i: usize) -> [u32; 2] {
        let photo = &self.capture.images[self.views[i]];
        [photo.width, photo.height]
    }

    fn open(&self, i: usize) -> Result<Cow<'_, Image>> {
        Ok(Cow::Borrowed(&self.capture.images[self.views[i]]))
    }

    fn depth(&self, i: usize) -> Result<Option<Cow<'_, [f32]>>> {
        Ok(self.depth.then(|| Cow::Borrowed(&self.capture.depths[self.views[i]][..])))
    }
}

/// `rough` points are off by up to a fifth of their depth.
fn points(capture: &Capture, views: &[usize], step: usize, rough: f64) -> Scene {
    let mut cloud = PointCloud::default();
    for view in views {
        let (camera, image) = (&capture.cameras[*view], &capture.images[*view]);
        for (at, depth) in capture.depths[*view].iter().enumerate().step_by(step).filter(|(_, depth)| **depth > 0.0) {
            let [x, y] = [at as u32 % image.width, at as u32 / image.width].map(|at| f64::from(at) + 0.5);
            let i = camera.intrinsics;
            let off = 1.0 + rough * (12.9898 * at as f64 + *view as f64).sin();
            let ray = glam::DVec3::new((x - i.cx) / i.fx, (y - i.cy) / i.fy, 1.0);
            let point = camera.pose.transform(f64::from(*depth) * off * ray);
            cloud.positions.push(point.as_vec3().to_array());
            cloud.colors.push([0, 1, 2].map(|c| image.rgb[3 * at + c]));
        }
    }
    Scene::from_points(&cloud, &capture.cameras).expect("points")
}

fn refined(scene: &Scene, photos: Known<'_>, options: &RefineOptions) -> RefineResult {
    let cameras: Vec<Camera> = photos.views.iter().map(|view| photos.capture.cameras[*view]).collect();
    let options = RefineOptions { holdout_views: Some(0), ..options.clone() };
    refine_scene(&Arena::new(device()), scene, photos, &cameras, &options, |_| ControlFlow::Continue(()))
        .expect("it runs")
}

fn draw(scene: &Scene, cameras: &[Camera]) -> Vec<RenderOutput> {
    let options = RenderOptions { alpha: true, depth: Some(Depth::Expected), ..RenderOptions::default() };
    Renderer::new(device()).render_scene(scene, cameras, &options).expect("pictures")
}

/// Mean PSNR against photos, and median relative error of depth.
fn scores(scene: &Scene, cameras: &[Camera], images: &[Image], depths: &[Vec<f32>]) -> [f64; 2] {
    let (mut sum, mut errors) = (0.0, Vec::new());
    for (i, drawn) in draw(scene, cameras).into_iter().enumerate() {
        let rgb: Vec<f32> = drawn.rgb.expect("color").iter().map(|value| value.clamp(0.0, 1.0)).collect();
        sum += psnr(&rgb, &values(&images[i])) / images.len() as f64;
        let pairs = drawn.depth.expect("depth").into_iter().zip(depths.get(i).into_iter().flatten().copied());
        errors.extend(
            pairs.filter(|(_, truth)| *truth > 0.0).map(|(depth, truth)| f64::from((depth / truth - 1.0).abs())),
        );
    }
    errors.sort_by(f64::total_cmp);
    [sum, errors.get(errors.len() / 2).copied().unwrap_or(0.0)]
}

fn shrunk(image: &Image, factor: u32) -> Image {
    let (width, height) = (image.width / factor, image.height / factor);
    let value = |at: u32| {
        let (channel, x, y) = (at % 3, at / 3 % width, at / 3 / width);
        let pixel = |k: u32| ((y * factor + k / factor) * image.width + x * factor + k % factor) * 3 + channel;
        let sum: u32 = (0..factor * factor).map(|k| u32::from(image.rgb[pixel(k) as usize])).sum();
        (sum as f32 / (factor * factor) as f32).round() as u8
    };
    Image::new(width, height, (0..3 * width * height).map(value).collect()).expect("an image")
}

fn resized(camera: &Camera, side: u32) -> Camera {
    Camera { intrinsics: camera.intrinsics.resized(side, side), ..*camera }
}

#[test]
fn antialiased_scenes_keep_their_width_at_other_sizes() {
    let side = 64;
    let [photos, large] = [side, 2 * side].map(|side| capture(2, &options(side)));
    let (training, tested): (Vec<usize>, Vec<usize>) = (0..12).partition(|view| view % 3 != 1);
    let start = points(&photos, &training, 5, 0.0);
    let options = RefineOptions { length: RefineLength::Steps(100), ..RefineOptions::default() };
    let psnr_at = |antialiased: bool| {
        let options = RefineOptions { antialiased: Some(antialiased), ..options.clone() };
        let known = Known { capture: &photos, views: training.clone(), depth: false };
        let scene = refined(&start, known, &options).scene;
        assert_eq!(scene.antialiased, antialiased);
        [(16, 4), (32, 2), (64, 1), (128, 0)].map(|(side, factor)| {
            let images: Vec<Image> = tested
                .iter()
                .map(
                    |view| {
                        if factor == 0 { large.images[*view].clone() } else { shrunk(&photos.images[*view], factor) }
                    },
                )
                .collect();
            let cameras: Vec<Camera> = tested.iter().map(|view| resized(&photos.cameras[*view], side)).collect();
            scores(&scene, &cameras, &images, &[])[0]
        })
    };
    let (plain, filtered) = (psnr_at(false), psnr_at(true));
    println!("PSNR at 1/4, 1/2, 1 and 2 times the size: {plain:.2?}, antialiased {filtered:.2?}");
    let gains = [0, 1, 2, 3].map(|i| filtered[i] - plain[i]);
    assert!(gains[0] > 3.0 && gains[1] > 1.0 && gains[2] > -0.5 && gains[3] > 0.3, "{gains:.2?}");
}

#[test]
fn known_depth_of_few_photos_improves_other_views() {
    let photos = capture(2, &options(64));
    let (training, tested) = (vec![0, 5, 11], [1, 3, 7, 9]);
    let start = points(&photos, &training, 3, 0.2);
    let cameras: Vec<Camera> = tested.iter().map(|view| photos.cameras[*view]).collect();
    let [images, depths] = [(); 2].map(|()| tested.to_vec());
    let images: Vec<Image> = images.iter().map(|view| photos.images[*view].clone()).collect();
    let depths: Vec<Vec<f32>> = depths.iter().map(|view| photos.depths[*view].clone()).collect();
    let score = |depth_loss: Option<DepthLoss>| {
        let options = RefineOptions { length: RefineLength::Steps(100), depth_loss, ..RefineOptions::default() };
        let known = Known { capture: &photos, views: training.clone(), depth: depth_loss.is_some() };
        let found = refined(&start, known, &options);
        assert_eq!(found.depth_fraction > 0.5, depth_loss.is_some());
        scores(&found.scene, &cameras, &images, &depths)
    };
    let [without, metric, relative] =
        [None, Some(DepthKind::Metric), Some(DepthKind::Relative)].map(|kind| score(kind.map(DepthLoss::of)));
    println!("PSNR and depth error: {without:.4?}, known depth {metric:.4?}, relative depth {relative:.4?}");
    assert!(metric[0] > without[0] + 0.5 && metric[1] < 0.7 * without[1], "{metric:?}, {without:?}");
    // The fit keeps the scale of the rough points.
    assert!(relative[0] > without[0] + 0.5, "{relative:?}, {without:?}");
}

#[test]
fn unknown_depth_changes_nothing() {
    let photos = capture(2, &options(32));
    let start = points(&photos, &[0], 3, 0.1);
    let scene = |depth_loss| {
        let options = RefineOptions { length: RefineLength::Steps(5), depth_loss, ..RefineOptions::default() };
        refined(&start, Known { capture: &photos, views: vec![0, 3], depth: false }, &options).scene
    };
    assert_eq!(scene(Some(DepthLoss::of(DepthKind::Metric))), scene(None));
}
