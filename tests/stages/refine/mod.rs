mod cameras;
mod checkpoint;
mod exposure;
mod masks;
mod memory;
mod opened;

use std::time::Duration;
use zipsplat::refine::{
    LearningRates, PerceptualLoss, RefineLength, RefineOptions, RefineProgress, RefineResult, StopReason, refine_scene,
};
use zipsplat::{gpu::Arena, perceptual::Perceptual, stages::lpips::LpipsNetwork};
use zipsplat_tests::golden::lpips_weights;
use zipsplat_tests::prelude::*;

fn cameras(count: usize) -> Vec<Camera> {
    let at = |i: usize| {
        let mut camera = if i.is_multiple_of(2) { camera(48, 36) } else { camera(40, 40) };
        camera.pose.translation.x += 0.05 * i as f64;
        camera
    };
    (0..count).map(at).collect()
}

fn photos(cameras: &[Camera]) -> (Scene, Vec<Image>) {
    let scene = random_scene(80, 1, 0.3);
    let photos = photos_of(&scene, cameras);
    (scene, photos)
}

fn photos_of(scene: &Scene, cameras: &[Camera]) -> Vec<Image> {
    let frames = Renderer::new(device()).render_scene(scene, cameras, &RenderOptions::default()).unwrap();
    let photo = |frame: RenderOutput| Image::from_rgb_f32(frame.width, frame.height, &frame.rgb.unwrap()).unwrap();
    frames.into_iter().map(photo).collect()
}

fn moved(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    let shift = |i: usize| 0.1 * (i as f32 * 2.4).sin();
    scene.means.iter_mut().flatten().enumerate().for_each(|(i, value)| *value += shift(i));
    scene.scales.iter_mut().flatten().enumerate().for_each(|(i, value)| *value *= 1.0 + 2.0 * shift(i));
    scene.sh_coeffs.iter_mut().flatten().enumerate().for_each(|(i, value)| *value += 3.0 * shift(i));
    scene
}

fn refine(scene: &Scene, photos: &[Image], cameras: &[Camera], request: &RefineOptions) -> RefineResult {
    refine_scene(&Arena::new(device()), scene, photos, cameras, request, |_| ControlFlow::Continue(())).unwrap()
}

fn sixty_steps_at_full_size() -> RefineOptions {
    RefineOptions {
        length: RefineLength::Steps(60),
        coarse_to_fine: false,
        max_gaussians: Some(0),
        ..RefineOptions::default()
    }
}

#[test]
fn needles_become_shorter() {
    let cameras = cameras(4);
    let (scene, photos) = photos(&cameras);
    let mut needles = moved(&scene);
    needles.scales.iter_mut().for_each(|[x, y, z]| (*x, *y, *z) = (0.4, 0.02, 0.01));
    let refined = refine(&needles, &photos, &cameras, &sixty_steps_at_full_size());
    assert!(refined.best_step > 40, "{}", refined.best_step);
    let ratio = |scales: &[f32; 3]| {
        let mut sorted = *scales;
        sorted.sort_by(f32::total_cmp);
        sorted[2] / sorted[1]
    };
    let largest = refined.scene.scales.iter().map(ratio).fold(0.0, f32::max);
    assert!(largest < 5.001, "{largest}");
}

fn white(photos: &[Image]) -> Vec<Image> {
    photos.iter().map(|photo| Image { rgb: vec![255; photo.rgb.len()], ..photo.clone() }).collect()
}

fn with_large_steps_of_scales() -> RefineOptions {
    let default = LearningRates::default();
    RefineOptions {
        learning_rates: LearningRates { scales: 20.0 * default.scales, ..default },
        ..sixty_steps_at_full_size()
    }
}

/// White photos widen Gaussians until they veil cameras.
#[test]
fn floaters_are_cleared_without_growth() {
    let cameras = cameras(4);
    let (scene, photos) = photos(&cameras);
    let widest = |steps: usize| {
        let request = RefineOptions { length: RefineLength::Steps(steps), ..with_large_steps_of_scales() };
        let Scene { means, scales, .. } = refine(&moved(&scene), &white(&photos), &cameras, &request).scene;
        let ratio = |(mean, scales): (&[f32; 3], &[f32; 3])| {
            let distances = cameras.iter().map(|camera| camera.pose.translation.distance(mean.map(f64::from).into()));
            f64::from(glam::Vec3::from(*scales).max_element()) / distances.fold(f64::INFINITY, f64::min)
        };
        means.iter().zip(&scales).map(ratio).fold(0.0, f64::max)
    };
    let [kept, cleared] = [49, 60].map(widest);
    assert!(kept > 5.0 && cleared < 3.0, "{kept} and {cleared}");
}

#[test]
fn gaussians_that_photos_hardly_constrain_hardly_move() {
    let cameras = cameras(4);
    let (scene, photos) = photos(&cameras);
    let mut with_faint = scene.clone();
    with_faint.opacities[0] = 0.01;
    let refined = refine(&with_faint, &photos, &cameras, &sixty_steps_at_full_size());
    assert!(refined.best_step > 40, "{}", refined.best_step);
    let moved = glam::Vec3::from(refined.scene.means[0]).distance(with_faint.means[0].into());
    assert!(moved < 0.02, "{moved}");
}

#[test]
fn moved_gaussians_find_back_and_always_alike() {
    let cameras = cameras(9);
    let (scene, photos) = photos(&cameras);
    let request = RefineOptions {
        length: RefineLength::Steps(40),
        views_per_step: 3,
        holdout_views: Some(1),
        profile: true,
        ..RefineOptions::default()
    };
    let refined = refine(&moved(&scene), &photos, &cameras, &request);
    refined.scene.validate().unwrap();
    let [after, before] = refined.psnr().unwrap();
    assert!(after > before + 3.0, "{before} to {after} dB");
    assert!(refined.losses[39] < 0.5 * refined.losses[0], "{:?}", refined.losses);
    assert_eq!((refined.stop_reason.clone(), refined.losses.len(), refined.holdout_psnr.len()), (None, 40, 21));
    let profile = refined.profile.as_ref().unwrap();
    assert!(profile.rows.iter().any(|row| row.kernel.contains("adam") || row.scope.contains("adam")));
    let again = refine(&moved(&scene), &photos, &cameras, &request);
    assert!(again.scene == refined.scene && again.losses == refined.losses);
}

#[test]
fn a_photo_that_is_masked_away_measures_nothing() {
    let cameras = cameras(4);
    let (scene, mut photos) = photos(&cameras);
    photos[2].mask = Some(vec![0; photos[2].rgb.len() / 3]);
    let request = RefineOptions { length: RefineLength::Steps(20), holdout_views: Some(1), ..RefineOptions::default() };
    let refined = refine(&moved(&scene), &photos, &cameras, &request);
    assert_eq!((refined.holdout_views, refined.holdout_psnr), (vec![2], Vec::new()));
    assert!(refined.best_step > 0 && refined.training_psnr[0] > refined.training_psnr[1]);
}

#[test]
fn a_time_becomes_steps() {
    let cameras = cameras(4);
    let (scene, photos) = photos(&cameras);
    let steps = |time| {
        let request = RefineOptions { length: RefineLength::Time(time), ..RefineOptions::default() };
        let refined = refine(&moved(&scene), &photos, &cameras, &request);
        assert_eq!(refined.losses.len(), refined.steps);
        refined.steps
    };
    assert_eq!(steps(Duration::ZERO), 1);
    assert!((8..16).any(|power| steps(Duration::from_millis(1 << power)) > 1), "one step in any time");
}

#[test]
fn photos_of_a_step_together_are_as_one_after_the_other() {
    let cameras = cameras(6);
    let (scene, photos) = photos(&cameras);
    let with = |batch_size: usize| {
        let request = RefineOptions {
            length: RefineLength::Steps(8),
            views_per_step: 5,
            batch_size: Some(batch_size),
            ..RefineOptions::default()
        };
        refine(&moved(&scene), &photos, &cameras, &request)
    };
    let (alone, batched) = (with(1), with(3));
    assert_eq!(alone.losses[0], batched.losses[0]);
    // Batches sum in another order.
    for (alone, batched) in alone.losses.iter().zip(&batched.losses) {
        assert!((alone - batched).abs() < 1e-3 * alone, "{alone} and {batched}");
    }
}

#[test]
fn the_best_so_far_is_returned_when_asked_to_stop() {
    let cameras = cameras(3);
    let (scene, photos) = photos(&cameras);
    let mut steps = Vec::new();
    let progress = |at: RefineProgress<'_>| {
        steps.push(at.step);
        if at.step == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let start = moved(&scene);
    let refined = refine_scene(
        &Arena::new(device()),
        &start,
        &photos,
        &cameras,
        &RefineOptions { length: RefineLength::Steps(100), ..RefineOptions::default() },
        progress,
    )
    .unwrap();
    assert_eq!((refined.stop_reason, refined.best_step, refined.losses.len()), (Some(StopReason::Cancelled), 3, 3));
    assert_eq!(steps, [1, 2, 3]);
    assert_ne!(refined.scene, start);
    let none = refine(
        &start,
        &photos,
        &cameras,
        &RefineOptions { length: RefineLength::Steps(0), ..RefineOptions::default() },
    );
    assert_eq!((none.scene, none.best_step), (start, 0));
}

#[test]
fn scenes_are_shown_on_the_way() {
    let cameras = cameras(3);
    let (scene, photos) = photos(&cameras);
    let mut shown = Vec::new();
    let progress = |at: RefineProgress<'_>| {
        shown.extend(at.scene.map(|scene| (at.step, scene.clone())));
        ControlFlow::Continue(())
    };
    let request = RefineOptions { length: RefineLength::Steps(7), snapshots: 3, ..RefineOptions::default() };
    let refined = refine_scene(&Arena::new(device()), &moved(&scene), &photos, &cameras, &request, progress).unwrap();
    assert_eq!(shown.iter().map(|(step, _)| *step).collect::<Vec<_>>(), [3, 5, 7]);
    assert_ne!(shown[0].1, shown[1].1);
    assert_ne!(shown[1].1, refined.scene);
    let unseen = refine(&moved(&scene), &photos, &cameras, &RefineOptions { snapshots: 0, ..request });
    assert_eq!(unseen.scene, refined.scene);
}

#[test]
fn a_loss_that_grows_ends_with_the_last_good_scene() {
    let cameras = cameras(2);
    let (scene, photos) = photos(&cameras);
    // The first step makes the scene worse.
    let rates = LearningRates { means: 10.0, ..LearningRates::default() };
    let request = RefineOptions {
        length: RefineLength::Steps(20),
        views_per_step: 2,
        learning_rates: rates,
        ..RefineOptions::default()
    };
    let refined = refine(&scene, &photos, &cameras, &request);
    assert!(
        matches!(&refined.stop_reason, Some(StopReason::Diverged(why)) if why.contains("grew")),
        "{:?}",
        refined.stop_reason
    );
    assert_eq!((refined.best_step, refined.losses.len()), (0, 2));
    assert_eq!(refined.scene, scene);
}

#[test]
fn what_cannot_be_refined_is_refused() {
    let cameras = cameras(2);
    let (scene, photos) = photos(&cameras);
    let refused = |scene: &Scene, cameras: &[Camera], request: &RefineOptions, words: &str| {
        let never = |_: RefineProgress<'_>| -> ControlFlow<()> { panic!("a step") };
        assert_refused(refine_scene(&Arena::new(device()), scene, &photos, cameras, request, never), &[words]);
    };
    let request = RefineOptions::default();
    refused(&scene, &cameras[..1], &request, "cameras");
    let mut telescopes = cameras.clone();
    telescopes[1].intrinsics.fx = 1e12;
    refused(&scene, &telescopes, &request, "camera 1, fx");
    refused(&Scene::default(), &cameras, &request, "no Gaussians");
    let behind = Scene { means: scene.means.iter().map(|m| [m[0], m[1], -m[2]]).collect(), ..scene.clone() };
    refused(&behind, &cameras, &request, "no Gaussian that any photo's camera sees");
    refused(&scene, &cameras, &RefineOptions { holdout_views: Some(2), ..request }, "held-out");
}

#[test]
fn a_scene_with_a_tenth_of_its_gaussians_grows() {
    let cameras = cameras(9);
    let scene = random_scene(400, 0, 0.3);
    let photos = photos_of(&scene, &cameras);
    let mut start = scene.clone();
    start.keep(&(0..400).step_by(10).collect::<Vec<_>>());
    let with = |max_gaussians: usize| {
        refine(
            &start,
            &photos,
            &cameras,
            &RefineOptions {
                length: RefineLength::Steps(100),
                max_gaussians: Some(max_gaussians),
                holdout_views: Some(1),
                ..RefineOptions::default()
            },
        )
    };
    let (without, grown) = (with(0), with(400));
    let [[kept, _], [more, _]] = [&without, &grown].map(|refined| refined.psnr().unwrap());
    assert!(more > kept + 0.5, "{kept} dB with {} Gaussians, {more} with {}", without.scene.len(), grown.scene.len());
    assert!(without.scene.len() == 40 && (200..=400).contains(&grown.scene.len()));
    grown.scene.validate().unwrap();
    let again = with(400);
    assert!(again.scene == grown.scene && again.losses == grown.losses);
}

#[test]
fn scenes_grow_by_default_unless_good() {
    let cameras = cameras(4);
    let scene = random_scene(40, 0, 0.3);
    let photos = photos_of(&scene, &cameras);
    let mut start = scene.clone();
    start.keep(&(0..40).step_by(10).collect::<Vec<_>>());
    let len = |scene: &Scene| {
        let request = RefineOptions { length: RefineLength::Steps(50), ..RefineOptions::default() };
        let refined = refine(scene, &photos, &cameras, &request);
        assert!(refined.best_step > 0);
        (refined.training_psnr[1] < 25.0, refined.scene.len())
    };
    let (is_poor, grown) = len(&start);
    assert!(is_poor && grown > 4, "{grown}");
    let mut good = scene.clone();
    good.sh_coeffs.iter_mut().for_each(|[red, ..]| *red += 0.05);
    assert_eq!(len(&good), (false, 40));
}

/// 0..1, `[height][width][rgb]`.
fn pair(scene: &Scene, camera: &Camera, photo: &Image) -> [Vec<f32>; 2] {
    let frame = Renderer::new(device()).render_scene(scene, &[*camera], &RenderOptions::default()).unwrap().remove(0);
    let drawn = frame.rgb.unwrap().into_iter().map(|value| value.clamp(0.0, 1.0)).collect();
    [drawn, photo.rgb.iter().map(|value| f32::from(*value) / 255.0).collect()]
}

#[test]
fn lpips_is_a_share_of_the_loss_where_asked() {
    let network = LpipsNetwork::Vgg;
    let Some(weights) = lpips_weights(network) else { return };
    let cameras = cameras(3);
    let (scene, photos) = photos(&cameras);
    let (start, mut lpips) = (moved(&scene), Perceptual::open(device(), network, &weights, false).unwrap());
    let mut distance = |scene: &Scene| {
        let of = |i: usize| {
            let [drawn, photo] = pair(scene, &cameras[i], &photos[i]);
            lpips.distance([&drawn, &photo], [photos[i].width, photos[i].height]).unwrap()
        };
        (0..3).map(of).collect::<Vec<f64>>().iter().sum::<f64>() / 3.0
    };
    // Small rates, so that the loss falls.
    let LearningRates { means, scales, sh_coeffs, .. } = LearningRates::default();
    let rates = LearningRates {
        means: 0.02 * means,
        scales: 0.02 * scales,
        sh_coeffs: 0.02 * sh_coeffs,
        ..LearningRates::default()
    };
    let rates = LearningRates { quats: 0.0, opacities: 0.0, ..rates };
    let with = |perceptual_loss: Option<PerceptualLoss>, steps: usize| {
        let request = RefineOptions {
            length: RefineLength::Steps(steps),
            perceptual_loss,
            learning_rates: rates,
            views_per_step: 3,
            batch_size: Some(3),
            ..RefineOptions::default()
        };
        refine(&start, &photos, &cameras, &request)
    };
    let perceptual_loss = |weight: f32| Some(PerceptualLoss { weight, network });
    let [plain, looked] = [with(None, 1), with(perceptual_loss(0.5), 1)].map(|refined| f64::from(refined.losses[0]));
    let expected = plain + 0.5 * distance(&start);
    assert!((looked - expected).abs() < 1e-4 * expected, "{looked}, expected {expected}");
    // The first step follows signs alone: only the term's own gradient reduces it this much.
    let [plain, looked] = [None, perceptual_loss(1e3)]
        .map(|perceptual_loss| distance(&start) - distance(&with(perceptual_loss, 1).scene));
    assert!(looked > 0.0 && looked > 1.05 * plain, "nearer by {looked} with, {plain} without");
    assert_eq!(with(perceptual_loss(0.0), 3).losses, with(None, 3).losses, "a share of 0 changes nothing");
}
