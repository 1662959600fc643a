//! Projection, order and blending of Gaussians, as pictures.

use super::{
    Area, Case, Mode, Worst,
    bound::U,
    picture::{PixelBounds, bounds, orders_depths, truth},
};
use crate::noise::{Noise, camera};
use glam::{DMat3, DVec3};
use zipsplat::{
    Result,
    gpu::Device,
    stages::render::{Depth, RenderRequest, Renderer},
    types::{Camera, Pose, Scene},
};
use zipsplat_reference::render::rasterise::Rendering;

const REASON: &str = "running error analysis (Wilkinson) of projection and blending, formula by formula: every value carries what \
    rounding may have added; where alpha may lie on either side of 1/255, or transmittance of 1e-4, both pictures are allowed";

/// Holds a picture of `scene` to its truth.
pub fn check(device: &Device, scene: &Scene, camera: &Camera, antialiased: bool) -> Result<Worst> {
    check_all(device, scene, std::slice::from_ref(camera), antialiased)
}

/// Holds pictures of `scene`, drawn together where they are of one size, to their truth.
pub fn check_all(device: &Device, scene: &Scene, cameras: &[Camera], antialiased: bool) -> Result<Worst> {
    let request =
        RenderRequest { alpha: true, depth: Some(Depth::Accumulated), antialiased, ..RenderRequest::default() };
    let frames = Renderer::new(device).render(scene, cameras, &request)?;
    let mut worst = Worst::NONE;
    let mut known: Option<(Camera, Rendering, Vec<PixelBounds>)> = None;
    for (frame, camera) in frames.into_iter().zip(cameras) {
        let (_, truth, bounds) = match known.take().filter(|(of, ..)| of == camera) {
            Some(same) => known.insert(same),
            None => {
                assert!(orders_depths(scene, camera), "a case whose order of depths f32 decides");
                known.insert((*camera, truth(scene, camera, antialiased), bounds(scene, camera, antialiased)))
            }
        };
        let plane = |values: Option<Vec<f32>>| values.unwrap_or_default();
        // Truth, too, was rounded in f64, and is blended by another formula.
        let slack = |truth: f64| U * 1e-3 * truth.abs();
        let rgb = Worst::of(&plane(frame.rgb), &truth.rgb, |i| bounds[i / 3][i % 3] + slack(truth.rgb[i]));
        let alpha = Worst::of(&plane(frame.alpha), &truth.alpha, |i| bounds[i][3] + slack(1.0));
        let depth = Worst::of(&plane(frame.depth), &truth.depth, |i| bounds[i][4] + slack(truth.depth[i]));
        worst = worst.or(rgb).or(alpha).or(depth);
    }
    Ok(worst)
}

/// Gaussians that change is applied to, one by one.
fn scene(count: usize, degree: u32, change: impl Fn(usize, &mut [f32; 3], &mut [f32; 3], &mut f32)) -> Scene {
    let mut scene = Noise(count as u64 + 1).scene(count, degree);
    for i in 0..count {
        change(i, &mut scene.means[i], &mut scene.scales[i], &mut scene.opacities[i]);
    }
    scene
}

/// The scene moved to where a turned camera sees it as before.
fn turned(mut scene: Scene, pose: Pose) -> (Scene, Camera) {
    for mean in &mut scene.means {
        *mean = pose.transform(DVec3::from(mean.map(f64::from))).as_vec3().to_array();
    }
    (scene, Camera { pose, ..camera(70, 53) })
}

/// Needles through the picture of [`camera`] whose centres lie `distance` pixels off it, in all directions.
fn needles_off(count: usize, distance: f64) -> Scene {
    scene(count, 0, |i, mean, scales, _| {
        let along = DVec3::from_array([(i as f64).cos(), (i as f64).sin(), 0.0]);
        let (depth, f) = (1.0 + 0.1 * i as f64, 70.0);
        let seen = DVec3::from(mean.map(f64::from)) / f64::from(mean[2]);
        *mean = ((seen + distance / f * along) * depth).as_vec3().to_array();
        *scales = [(distance / f * depth) as f32, 1e-3, 2e-3];
    })
}

/// So many cameras with 2,048 tiles each, of which the last alone stands elsewhere: they are drawn together.
fn many_tiles(cameras: usize) -> Vec<Camera> {
    let mut cameras = vec![camera(1, 32_768); cameras];
    if let Some(last) = cameras.last_mut() {
        last.pose.translation.x = 0.25;
    }
    cameras
}

pub fn area() -> Area {
    let mut cases = Vec::new();
    let mut add = |name: &str, (scene, camera): (Scene, Camera), antialiased: bool| {
        let size = scene.len();
        cases.push(Case::new(name, size, move |device, _| check(device, &scene, &camera, antialiased)));
    };
    let still = || camera(70, 53);
    let keep = |_: usize, _: &mut [f32; 3], _: &mut [f32; 3], _: &mut f32| ();
    for (count, degree) in [(1, 0), (10, 1), (100, 2), (1000, 3)] {
        add(&format!("random, degree {degree}"), (scene(count, degree, keep), still()), false);
        add(&format!("random, degree {degree}, antialiased"), (scene(count, degree, keep), still()), true);
    }
    let pose = Pose {
        rotation: DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.1),
        translation: DVec3::new(3.0, -1.0, 2.0),
    };
    add("a turned camera", turned(scene(60, 1, keep), pose), false);
    for distance in [1e4, 1e6] {
        let far = Pose { translation: distance * DVec3::new(1.0 / 3.0, 0.1, 1.0 / 7.0), ..pose };
        // Depths that are apart also where f32 holds them to a sixteenth.
        let spread = |i: usize, m: &mut [f32; 3], _: &mut [f32; 3], _: &mut f32| {
            let depth = 1.0 + 0.25 * i as f32;
            *m = m.map(|x| x * depth / m[2]);
        };
        add(&format!("scene and camera {distance:e} off"), turned(scene(40, 2, spread), far), false);
    }
    for distance in [1e3, 1e5] {
        let mut off = needles_off(40, distance);
        for (i, quat) in off.quats.iter_mut().enumerate() {
            *quat = [(0.5 * i as f32).cos(), 0.0, 0.0, (0.5 * i as f32).sin()];
        }
        add(&format!("needles {distance:e} pixels off the picture"), (off, still()), false);
    }
    let needles = |_: usize, _: &mut [f32; 3], s: &mut [f32; 3], _: &mut f32| *s = [0.0, 1e-6, 15.0];
    add("scales of 0, 1e-6 and 15 in one", (scene(50, 0, needles), still()), false);
    add("scales of 0, 1e-6 and 15 in one, antialiased", (scene(50, 0, needles), still()), true);
    add("points", (scene(200, 0, |_, _, s, _| *s = [0.0; 3]), still()), false);
    add("one over all tiles", (scene(1, 1, |_, m, s, _| (*m, *s) = ([0.1, 0.2, 3.0], [50.0; 3])), still()), false);
    for length in [1e-20, 1e-3, 1e3, 1e20] {
        let mut stretched = scene(60, 0, keep);
        stretched.quats.iter_mut().flatten().for_each(|q| *q *= length);
        add(&format!("rotations of length {length:e}"), (stretched, still()), false);
    }
    add("equal depths", (scene(300, 0, |_, m, s, _| (m[2], *s) = (3.0, [0.1; 3])), still()), false);
    add(
        "on the near plane",
        (
            scene(40, 0, |i, m, s, _| {
                // Not 0.01 itself, which f32 rounds to below it.
                let z = f32::from_bits(0.01f32.to_bits() + i as u32 - if i < 20 { 20 } else { 19 });
                (*m, *s) = ([0.3 * m[0] * z, 0.3 * m[1] * z, z], [1e-3; 3]);
            }),
            still(),
        ),
        false,
    );
    add(
        "at distances of 1e6",
        (
            scene(40, 1, |_, m, s, _| {
                m.iter_mut().chain(s).for_each(|v| *v *= 1e6);
            }),
            still(),
        ),
        false,
    );
    add("all behind", (scene(40, 0, |_, m, _, _| m[2] = -m[2]), still()), false);
    add(
        "camera inside",
        (scene(5, 1, |i, m, s, _| (*m, *s) = ([0.0, 0.01, 0.1 * (i + 1) as f32], [2.0; 3])), still()),
        false,
    );
    let faint = |i: usize, _: &mut [f32; 3], _: &mut [f32; 3], o: &mut f32| {
        *o = [0.0, 1.0 / 255.0, 1.0, 0.0039, 0.00393, 0.999][i % 6];
    };
    add("opacities of 0, 1/255 and 1", (scene(120, 0, faint), still()), false);
    add("opacities of 0, 1/255 and 1, antialiased", (scene(120, 0, faint), still()), true);
    let wall = |i: usize, m: &mut [f32; 3], s: &mut [f32; 3], o: &mut f32| {
        (*m, *s, *o) = ([0.0, 0.0, 2.0 + i as f32], [40.0; 3], 1.0);
    };
    add("opaque layers", (scene(4, 0, wall), still()), false);
    let mut dark = scene(80, 3, keep);
    dark.sh_coeffs.iter_mut().flatten().for_each(|c| *c = 2.0 * *c - 1.0);
    add("colours below zero", (dark, still()), false);
    for (width, height) in [(1, 1), (1, 2048), (2048, 1), (17, 33)] {
        add(&format!("{width} x {height} pixels"), (scene(40, 0, keep), camera(width, height)), false);
    }
    add("no Gaussians", (Scene::default(), still()), false);
    let mut far_off = still();
    (far_off.intrinsics.cx, far_off.intrinsics.cy) = (-60.0, 400.0);
    add("principal point outside", (scene(200, 0, keep), far_off), false);
    for degrees in [1.0f32, 179.0] {
        // What the usual camera sees of the scene, through a narrower or wider lens.
        let (half, mut lens) = ((0.5 * degrees).to_radians().tan(), still());
        let f = f64::from(lens.intrinsics.width) / 2.0 / f64::from(half);
        (lens.intrinsics.fx, lens.intrinsics.fy) = (f, f);
        let seen = scene(60, 1, |_, m, s, _| {
            (m[0], m[1]) = (2.0 * half * m[0], 2.0 * half * m[1]);
            s.iter_mut().for_each(|s| *s *= 2.0 * half);
        });
        add(&format!("a field of view of {degrees}°"), (seen, lens), false);
    }
    cases.push(Case::new("67,584 tiles", 40, move |device, _| {
        check_all(device, &scene(40, 0, keep), &many_tiles(33), false)
    }));
    Area { kernel: "render", size: "Gaussians", reason: REASON, modes: Mode::ONLY_EXACT, cases }
}
