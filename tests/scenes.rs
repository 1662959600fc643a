//! Scenes and cameras: the goldens' and generated ones.

use crate::golden::Golden;
use bytemuck::cast_slice;
use glam::{DMat3, DVec3};
use zipsplat::types::{Camera, Intrinsics, Pose, Scene};
pub use zipsplat_verify::{gaussians as reference_gaussians, reference_camera};

/// Returns the scene of a golden `raster.*`.
pub fn golden_scene(golden: &Golden) -> Scene {
    let coeffs = golden.shape("sh")[1];
    Scene {
        means: cast_slice(&golden.f32("means")).to_vec(),
        scales: cast_slice(&golden.f32("scales")).to_vec(),
        quats: cast_slice(&golden.f32("quats")).to_vec(),
        opacities: golden.f32("opacities"),
        sh_coeffs: cast_slice(&golden.f32("sh")).to_vec(),
        sh_degree: coeffs.isqrt() as u32 - 1,
    }
}

/// Returns the intrinsics of a golden's cameras.
pub fn intrinsics(golden: &Golden) -> Vec<Intrinsics> {
    let size = golden.u32("size_wh");
    let lens = |k: &[f64]| Intrinsics { width: size[0], height: size[1], fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
    golden.f64("Ks").chunks_exact(9).map(lens).collect()
}

/// Returns the cameras of a golden `raster.*`.
pub fn golden_cameras(golden: &Golden) -> Vec<Camera> {
    let viewmats = golden.f64("viewmats");
    let camera = |(view, intrinsics): (&[f64], Intrinsics)| {
        let row = |i: usize| DVec3::from_slice(&view[4 * i..]);
        let world_to_camera = Pose {
            rotation: DMat3::from_cols(row(0), row(1), row(2)).transpose(),
            translation: DVec3::new(view[3], view[7], view[11]),
        };
        Camera { intrinsics, pose: world_to_camera.inverse() }
    };
    viewmats.chunks_exact(16).zip(intrinsics(golden)).map(camera).collect()
}

/// Returns the same `count` Gaussians in front of [`camera`] on every call.
pub fn random_scene(count: usize, sh_degree: u32, size: f32) -> Scene {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut random = |low: f32, high: f32| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * ((state >> 40) as f32 / (1 << 24) as f32)
    };
    let mut scene = Scene { sh_degree, ..Scene::default() };
    for _ in 0..count {
        let depth = random(1.0, 6.0);
        scene.means.push([random(-0.6, 0.6) * depth, random(-0.6, 0.6) * depth, depth]);
        scene.scales.push([0; 3].map(|_| size * random(-3.0, 0.0).exp()));
        scene.quats.push([1.0, random(-1.0, 1.0), random(-1.0, 1.0), random(-1.0, 1.0)]);
        scene.opacities.push(random(0.0, 1.0));
        for k in 0..(sh_degree + 1).pow(2) {
            let reach = if k == 0 { 1.7 } else { 0.3 };
            scene.sh_coeffs.push([0; 3].map(|_| random(-reach, reach)));
        }
    }
    scene
}

/// Returns a camera at the origin looking along z, 53 degrees across its longer side.
pub fn camera(width: u32, height: u32) -> Camera {
    let focal = f64::from(width.max(height));
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera { intrinsics: Intrinsics { width, height, fx: focal, fy: focal, cx, cy }, pose: Pose::IDENTITY }
}
