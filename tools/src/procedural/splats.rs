//! A capture as Gaussians, from its exact depth: what a perfect reconstruction of its surfaces would look like.

use glam::DVec3;
use zipsplat::types::{Camera, Image, Scene};

use super::Capture;

/// First spherical harmonic, which is constant.
const SH0: f32 = 0.282_094_79;
/// Standard deviation of a splat in pixels of the photo that it is from: neighbours overlap without a visible grid.
const SIGMA: f64 = 0.6;
const OPACITY: f32 = 0.95;

impl Capture {
    /// One round Gaussian for every pixel of every photo that shows a surface, in the capture's world.
    pub fn splats(&self) -> Scene {
        self.splats_of(0..self.images.len())
    }

    /// The same of some of the photos.
    pub fn splats_of(&self, views: impl Iterator<Item = usize>) -> Scene {
        let mut scene = Scene { sh_degree: 0, ..Scene::default() };
        views.for_each(|i| add_view(&mut scene, &self.cameras[i], &self.images[i], &self.depths[i]));
        scene
    }
}

/// Adds one round Gaussian for every pixel of a photo whose depth is above 0.
pub fn add_view(scene: &mut Scene, camera: &Camera, image: &Image, depth: &[f32]) {
    let i = camera.intrinsics;
    for (at, (z, rgb)) in depth.iter().zip(image.rgb.as_chunks::<3>().0).enumerate().filter(|(_, (z, _))| **z > 0.0) {
        let z = f64::from(*z);
        let (x, y) = ((at % image.width as usize) as f64 + 0.5, (at / image.width as usize) as f64 + 0.5);
        let point = camera.pose.transform(DVec3::new((x - i.cx) / i.fx * z, (y - i.cy) / i.fy * z, z));
        scene.means.push(point.as_vec3().to_array());
        scene.scales.push([(SIGMA * z / i.fx) as f32; 3]);
        scene.quats.push([1.0, 0.0, 0.0, 0.0]);
        scene.opacities.push(OPACITY);
        scene.sh_coeffs.push(rgb.map(|value| (f32::from(value) / 255.0 - 0.5) / SH0));
    }
}
