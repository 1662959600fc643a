use crate::golden::Golden;
use bytemuck::cast_slice;
use glam::{DMat3, DMat4, DVec3};
use zipsplat::{
    gpu::Recorder,
    stages::render::SceneTensors,
    types::{Camera, Intrinsics, Pose, Scene, SceneFormat},
};
pub use zipsplat_verify::{gaussians as reference_gaussians, noise::camera, reference_camera};

pub fn golden_scene(golden: &Golden) -> Scene {
    let coeffs = golden.shape("sh")[1];
    Scene {
        means: cast_slice(&golden.f32("means")).to_vec(),
        scales: cast_slice(&golden.f32("scales")).to_vec(),
        quats: cast_slice(&golden.f32("quats")).to_vec(),
        opacities: golden.f32("opacities"),
        sh_coeffs: cast_slice(&golden.f32("sh")).to_vec(),
        sh_degree: coeffs.isqrt() as u32 - 1,
        antialiased: false,
    }
}

pub fn intrinsics(golden: &Golden) -> Vec<Intrinsics> {
    let size = golden.u32("size_wh");
    let lens = |k: &[f64]| Intrinsics { width: size[0], height: size[1], fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
    golden.f64("Ks").chunks_exact(9).map(lens).collect()
}

pub fn golden_cameras(golden: &Golden) -> Vec<Camera> {
    let lenses = intrinsics(golden);
    let view = |(view, intrinsics): (&[f64], Intrinsics)| Camera { intrinsics, pose: camera_pose(view) };
    golden.f64("viewmats").chunks_exact(16).zip(lenses).map(view).collect()
}

/// Row-major `[4, 4]`, world to camera.
pub fn camera_pose(view: &[f64]) -> Pose {
    let matrix = DMat4::from_cols_slice(view).transpose();
    Pose { rotation: DMat3::from_mat4(matrix), translation: matrix.w_axis.truncate() }.inverse()
}

/// The same `count` Gaussians before [`camera`] on every call.
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

/// `[n, 11 + 3K]`: means, scales, quaternions, opacities, SH coefficients.
pub fn packed(scene: &Scene) -> Vec<f32> {
    let k = scene.sh_coeffs_per_gaussian();
    let row = |i: usize| {
        let (fixed, sh) = ([scene.means[i], scene.scales[i]], &scene.sh_coeffs[i * k..][..k]);
        [fixed.as_flattened(), &scene.quats[i], &[scene.opacities[i]], sh.as_flattened()].concat()
    };
    (0..scene.len()).flat_map(row).collect()
}

pub fn fields(scene: &Scene) -> [(&'static str, &[f32]); 5] {
    [
        ("means", scene.means.as_flattened()),
        ("scales", scene.scales.as_flattened()),
        ("quats", scene.quats.as_flattened()),
        ("opacities", &scene.opacities),
        ("sh_coeffs", scene.sh_coeffs.as_flattened()),
    ]
}

pub fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

pub fn scene_extensions() -> impl Iterator<Item = &'static str> {
    SceneFormat::ALL.iter().map(|format| &format.extension()[1..])
}

/// Row-major rotation, then translation.
pub fn pose(row: &[f64]) -> Pose {
    Pose { rotation: DMat3::from_cols_slice(&row[..9]).transpose(), translation: DVec3::from_slice(&row[9..]) }
}

pub fn pose_rows<'a>(poses: impl IntoIterator<Item = &'a Pose>) -> Vec<f64> {
    let row = |pose: &Pose| [&pose.rotation.transpose().to_cols_array()[..], &pose.translation.to_array()].concat();
    poses.into_iter().flat_map(row).collect()
}

/// World-to-camera `[4, 4]` and intrinsics `[3, 3]`, row-major.
pub fn camera_of([view, k]: [&[f64]; 2], [width, height]: [u32; 2]) -> Camera {
    let intrinsics = Intrinsics { width, height, fx: k[0], fy: k[4], cx: k[2], cy: k[5] };
    Camera { intrinsics, pose: camera_pose(view) }
}

pub fn scene_inputs(rec: &mut Recorder, len: usize, sh_degree: u32) -> SceneTensors {
    SceneTensors {
        means: rec.input::<[f32; 3]>("means", len),
        scales: rec.input::<[f32; 3]>("scales", len),
        quats: rec.input::<[f32; 4]>("quats", len),
        opacities: rec.input::<f32>("opacities", len),
        sh_coeffs: rec.input::<[f32; 3]>("sh_coeffs", len * (sh_degree as usize + 1).pow(2)),
        len,
        sh_degree,
    }
}
