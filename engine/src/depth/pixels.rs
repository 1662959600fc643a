use super::{DepthMap, DepthPrediction, output::SKY, pixel_gaussians};
use crate::{
    stages::heads::{DEPTH_OFFSET, GAUSSIAN_VALUES},
    types::{Camera, Image, SH_0, Scene},
};
use glam::DVec3;

/// In pixels, enough to hide the grid.
const SIGMA: f64 = 0.6;
const OPACITY: f32 = 0.95;
const FAINT: f32 = 0.05;

/// Returns the world point of pixel `at` of rows of `width` pixels.
pub(super) fn pixel_point(camera: &Camera, at: usize, width: usize, depth: f64) -> [f32; 3] {
    let lens = camera.intrinsics;
    let (x, y) = ((at % width) as f64 + 0.5, (at / width) as f64 + 0.5);
    let ray = DVec3::new((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1.0);
    camera.pose.transform(ray * depth).as_vec3().to_array()
}

/// Adds an isotropic Gaussian per pixel of positive depth.
pub fn add_view(scene: &mut Scene, camera: &Camera, image: &Image, depth: &[f32]) {
    let shown = depth.iter().enumerate().filter(|(_, depth)| **depth > 0.0);
    shown.for_each(|(at, depth)| add_pixel(scene, camera, image, at, *depth, OPACITY));
}

fn add_pixel(scene: &mut Scene, camera: &Camera, image: &Image, at: usize, depth: f32, opacity: f32) {
    let z = f64::from(depth);
    scene.means.push(pixel_point(camera, at, image.width as usize, z));
    scene.scales.push([(SIGMA * z / camera.intrinsics.fx) as f32; 3]);
    scene.quats.push([1.0, 0.0, 0.0, 0.0]);
    scene.opacities.push(opacity);
    let rgb: [u8; 3] = std::array::from_fn(|c| image.rgb[3 * at + c]);
    scene.sh_coeffs.push(rgb.map(|value| (f32::from(value) / 255.0 - 0.5) / SH_0));
}

impl DepthPrediction {
    /// Returns a Gaussian per confident pixel of the kept patches, in the cameras' world.
    ///
    /// Without a head they are isotropic, with opacity by confidence. Sky and masked pixels have
    /// none. `keep` limits them per patch, by visibility.
    pub fn scene(&self, cameras: &[Camera], images: &[Image], keep: Option<usize>) -> Scene {
        let of_head = self.views.iter().any(|view| view.gaussians.is_some());
        let mut scene = Scene { sh_degree: if of_head { 2 } else { 0 }, ..Scene::default() };
        let (columns, side) = (self.width as usize / self.patch_size, self.patch_size);
        let patches = columns * (self.height as usize / side);
        let all: Vec<u32> = (0..(self.views.len() * patches) as u32).collect();
        let kept = self.patches.as_deref().unwrap_or(&all);
        let pixels = |patch: usize| {
            let corner = (patch / columns * columns * side + patch % columns) * side;
            (0..side * side).map(move |i| corner + i / side * columns * side + i % side)
        };
        let least = self.least_confidence();
        for (i, view) in self.views.iter().enumerate() {
            let of_view = kept.iter().map(|patch| *patch as usize).filter(|patch| patch / patches == i);
            let at: Vec<usize> = of_view.flat_map(|patch| pixels(patch % patches)).collect();
            let mut made = match &view.gaussians {
                Some(values) => {
                    let mut whole = pixel_gaussians(&view.depth, values, &cameras[i]);
                    whole.keep(&at);
                    whole
                }
                None => {
                    let mut round = Scene::default();
                    for &at in &at {
                        let (depth, opacity) = (view.depth[at], view.opacity(at, least));
                        add_pixel(&mut round, &cameras[i], &images[i], at, depth, opacity);
                    }
                    round
                }
            };
            let seen = |at: usize| view.shows(at) && view.offset_depth(at) > 0.0 && !images[i].ignores(at);
            for (i, _) in at.iter().enumerate().filter(|(_, at)| !seen(**at)) {
                (made.opacities[i], made.scales[i]) = (0.0, [0.0; 3]);
            }
            scene.append(made);
        }
        if let Some(keep) = keep {
            scene.keep_most_visible(side * side, keep);
        }
        let shown: Vec<usize> = (0..scene.len()).filter(|&i| scene.opacities[i] >= FAINT).collect();
        scene.keep(&shown);
        scene
    }
}

impl DepthMap {
    pub(super) fn mean_confidence(&self) -> f64 {
        let all = self.confidence.as_deref().unwrap_or(&[1.0]);
        all.iter().map(|value| f64::from(*value)).sum::<f64>() / all.len().max(1) as f64
    }

    pub(super) fn shows(&self, at: usize) -> bool {
        let sky = self.sky.as_ref().is_some_and(|sky| sky[at] >= SKY);
        !sky && self.depth[at].is_finite() && self.depth[at] > 0.0
    }

    /// Depth of the pixel's Gaussian.
    fn offset_depth(&self, at: usize) -> f32 {
        let offset = |values: &Vec<f32>| values[GAUSSIAN_VALUES * at + DEPTH_OFFSET];
        self.depth[at] + self.gaussians.as_ref().map_or(0.0, offset)
    }

    /// Linear in confidence above 1, full at `least`.
    fn opacity(&self, at: usize, least: f32) -> f32 {
        let Some(confidence) = &self.confidence else { return OPACITY };
        if least > 1.0 { OPACITY * ((confidence[at] - 1.0) / (least - 1.0)).clamp(0.0, 1.0) } else { OPACITY }
    }
}
