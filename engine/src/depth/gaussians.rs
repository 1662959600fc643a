//! Pixel-aligned Gaussians of Depth Anything 3's Gaussian head, in f64.

use crate::{
    stages::heads::{DEPTH_OFFSET, GAUSSIAN_VALUES},
    types::{Camera, Scene, matrix_from_quaternion, quaternion_from_matrix, sh_rotation},
};
use glam::DVec3;

/// In units of `PIXEL`.
const SCALES: [f64; 2] = [1e-5, 30.0];
const PIXEL: f64 = 0.1;
const COEFFS: usize = 9;
const SH_DEGREE: u32 = 2;
/// Coefficient scale by degree.
const FACTORS: [f64; 3] = [1.0, 0.025, 0.00625];

/// Decodes Gaussians in world space, for `depth` `[height, width]` of `camera` and `values`
/// `[height, width, GAUSSIAN_VALUES]`.
pub fn pixel_gaussians(depth: &[f32], values: &[f32], camera: &Camera) -> Scene {
    let lens = &camera.intrinsics;
    let rotation = camera.pose.rotation;
    let turned = sh_rotation(&rotation);
    let mut scene = Scene { sh_degree: SH_DEGREE, ..Scene::default() };
    for (i, (&depth, values)) in depth.iter().zip(values.chunks(GAUSSIAN_VALUES)).enumerate() {
        let value = |i: usize| f64::from(values[i]);
        let pixel = |at: usize, offset: usize| at as f64 + 0.5 + value(offset);
        let (x, y) = (pixel(i % lens.width as usize, 0), pixel(i / lens.width as usize, 1));
        let ray = DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0).normalize();
        let distance = f64::from(depth) + value(DEPTH_OFFSET);
        scene.means.push(camera.pose.transform(ray * distance).as_vec3().to_array());
        let unit = distance * PIXEL * (1.0 / lens.fx + 1.0 / lens.fy);
        scene.scales.push([2, 3, 4].map(|i| ((SCALES[0] + (SCALES[1] - SCALES[0]) * sigmoid(value(i))) * unit) as f32));
        // The weights depend on this order of the released code.
        let own = matrix_from_quaternion([value(7), value(8), value(5), value(6)]);
        let [w, x, y, z] = quaternion_from_matrix(&(rotation * own));
        scene.quats.push([x, y, z, w].map(|q| q as f32));
        scene.opacities.push(sigmoid(value(37)) as f32);
        let coefficient = |j: usize, color: usize| FACTORS[j.isqrt()] * value(9 + COEFFS * color + j);
        scene.sh_coeffs.extend((0..COEFFS).map(|j| {
            [0, 1, 2].map(|color| (0..COEFFS).map(|k| turned[j][k] * coefficient(k, color)).sum::<f64>() as f32)
        }));
    }
    scene
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}
