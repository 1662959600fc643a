use crate::{capture, options, rays, setup};
use zipsplat_cli::procedural::{Capture, Photos, Setup};
use zipsplat_tests::prelude::*;

/// Away from silhouettes: sphere tracing stops at 1e-4 of a tube's radius.
const RELATIVE: f64 = 5e-4;
/// Pixels within which rounding may select the other surface.
const BESIDE: f64 = 0.02;

fn ray(i: &Intrinsics, x: u32, y: u32, shift: (f64, f64)) -> DVec3 {
    let (x, y) = (f64::from(x) + 0.5 + shift.0, f64::from(y) + 0.5 + shift.1);
    DVec3::new((x - i.cx) / i.fx, (y - i.cy) / i.fy, 1.0)
}

#[test]
fn depth_is_that_of_brute_force_in_f64() {
    let options = options(3, 48);
    let mut compared = 0;
    for seed in 0..24 {
        let setup = setup(seed, &options);
        let capture = setup.shoot(&Photos::default(), &|| Ok(())).expect("nothing stops it");
        for (view, pose) in setup.poses().iter().enumerate() {
            let i = capture.cameras[view].intrinsics;
            // 0 in the sky.
            let truth = |x: u32, y: u32, shift: (f64, f64)| {
                let direction = ray(&i, x, y, shift);
                let length = direction.length();
                let unit = pose.rotation * direction / length;
                rays::nearest(setup.world.primitives(), pose.translation, unit).map_or(0.0, |t| t / length)
            };
            for k in 0..30 {
                let (x, y) = ((k * 37 + 11 * seed as u32) % 48, (k * 23 + 5 * view as u32) % 48);
                let found = f64::from(capture.depths[view][(y * 48 + x) as usize]) * capture.meters;
                let close = |z: f64| (found - z).abs() <= RELATIVE * z.max(1e-3);
                let shifts = [(0.0, 0.0), (BESIDE, 0.0), (-BESIDE, 0.0), (0.0, BESIDE), (0.0, -BESIDE)];
                let beside = shifts.map(|shift| truth(x, y, shift));
                let (low, high) = beside.iter().fold((f64::MAX, 0f64), |(low, high), z| (low.min(*z), high.max(*z)));
                let between = found >= low && found <= high;
                assert!(
                    close(beside[0]) || between || beside.into_iter().any(close),
                    "seed {seed} ({}), view {view}, pixel ({x}, {y}): found {found}, expected {beside:?}",
                    capture.family
                );
                compared += usize::from(found > 0.0);
            }
        }
    }
    assert!(compared > 1500, "only {compared} pixels show a surface");
}

fn project(camera: &Camera, point: DVec3) -> Option<(u32, u32, f64)> {
    let p = camera.pose.inverse().transform(point);
    let i = &camera.intrinsics;
    let (x, y) = (i.fx * p.x / p.z + i.cx, i.fy * p.y / p.z + i.cy);
    let inside = p.z > 0.0 && x >= 0.0 && y >= 0.0 && x < f64::from(i.width) && y < f64::from(i.height);
    inside.then_some((x as u32, y as u32, p.z))
}

/// Visible surfaces by the other view's depth.
struct Reprojection {
    surfaces: usize,
    seen: usize,
    color_errors: Vec<f64>,
    chance_errors: Vec<f64>,
}

fn reproject(capture: &Capture, from: usize, to: usize) -> Reprojection {
    let Intrinsics { width, height, .. } = capture.cameras[from].intrinsics;
    let color = |view: usize, x: u32, y: u32| {
        let at = 3 * (y * width + x) as usize;
        DVec3::from_slice(&[0, 1, 2].map(|c| f64::from(capture.images[view].rgb[at + c]) / 255.0))
    };
    let mut result = Reprojection { surfaces: 0, seen: 0, color_errors: Vec::new(), chance_errors: Vec::new() };
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        let Some(point) = capture.point(from, x, y) else { continue };
        result.surfaces += 1;
        let Some((u, v, z)) = project(&capture.cameras[to], point) else { continue };
        let there = f64::from(capture.depths[to][(v * width + u) as usize]);
        if (there - z).abs() > 0.03 * z {
            continue;
        }
        result.seen += 1;
        let here = color(from, x, y);
        let error = |other: DVec3| (here - other).abs().element_sum() / 3.0;
        result.color_errors.push(error(color(to, u, v)));
        result.chance_errors.push(error(color(to, (u + width / 2) % width, (v + height / 3) % height)));
    }
    result
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn points_land_on_the_same_colors_in_other_views() {
    let (mut errors, mut chance) = (Vec::new(), Vec::new());
    for seed in 100..125 {
        let capture = capture(seed, &options(6, 64));
        let found = reproject(&capture, 2, 3);
        errors.extend(found.color_errors);
        chance.extend(found.chance_errors);
    }
    let (error, chance) = (mean(&errors), mean(&chance));
    assert!(errors.len() > 30_000, "only {} points are seen twice", errors.len());
    // Half a pixel of texture, highlights and noise remain.
    assert!(error < 0.06 && error < 0.4 * chance, "colors differ by {error:.3}, at random places by {chance:.3}");
}

#[test]
fn every_view_is_seen_by_two_others() {
    use zipsplat_cli::procedural::{LEAST_OVERLAP, WITNESSES};
    for seed in 200..240 {
        let capture = capture(seed, &options(8, 48));
        for view in 0..8 {
            let share = |other: usize| {
                let found = reproject(&capture, view, other);
                found.seen as f32 / found.surfaces as f32
            };
            let mut shares: Vec<f32> = (0..8).filter(|other| *other != view).map(share).collect();
            shares.sort_by(|a, b| b.total_cmp(a));
            // The rule samples 144 rays; pixel centers miss thin surfaces.
            let least = LEAST_OVERLAP - 0.15;
            assert!(shares[WITNESSES - 1] >= least, "seed {seed} ({}), view {view}: seen {shares:?}", capture.family);
        }
    }
}

#[test]
fn stored_overlap_is_that_of_the_depth() {
    let mut differences = Vec::new();
    for seed in 300..315 {
        let capture = capture(seed, &options(5, 64));
        for (i, j) in (0..5).flat_map(|i| (0..5).map(move |j| (i, j))).filter(|(i, j)| i != j) {
            let found = reproject(&capture, i, j);
            let share = found.seen as f64 / found.surfaces as f64;
            differences.push((share - f64::from(capture.overlap[i * 5 + j])).abs());
        }
    }
    let difference = mean(&differences);
    assert!(difference < 0.08, "overlap by rays and by depth differ by {difference:.3} on average");
}

#[test]
fn world_is_the_first_camera_and_the_median_distance_is_one() {
    for seed in 0..10 {
        let capture = capture(seed, &options(4, 32));
        let first = capture.cameras[0].pose;
        assert!(first.rotation.abs_diff_eq(glam::DMat3::IDENTITY, 1e-6) && first.translation.length() < 1e-9);
        let views = (0..4).flat_map(|view| (0..32 * 32).map(move |k| (view, k % 32, k / 32)));
        let points = views.filter_map(|(view, x, y)| capture.point(view, x, y));
        let mut distances: Vec<f64> = points.map(DVec3::length).collect();
        distances.sort_by(f64::total_cmp);
        let median = distances[distances.len() / 2];
        assert!((median - 1.0).abs() < 1e-4, "seed {seed}: the median distance is {median}");
    }
}

#[test]
fn cameras_are_in_free_space() {
    for seed in 0..60 {
        let setup: Setup = setup(seed, &options(6, 32));
        for (view, pose) in setup.poses().iter().enumerate() {
            let eye = pose.translation.as_vec3a();
            assert!(!setup.world.contains(eye), "seed {seed}, view {view}: the camera is inside something");
        }
    }
}
