use zipsplat::{
    random::Random,
    types::{Camera, Image, Intrinsics, Pose, Scene},
};

pub struct Noise(Random);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(Random::new(seed))
    }

    pub fn uniform(&mut self, low: f32, high: f32) -> f32 {
        self.0.uniform(low, high)
    }

    /// Uniform in -1..1.
    pub fn values(&mut self, len: usize) -> Vec<f32> {
        (0..len).map(|_| self.uniform(-1.0, 1.0)).collect()
    }

    pub fn image(&mut self, width: u32, height: u32) -> Image {
        let rgb = (0..3 * width as usize * height as usize).map(|_| (self.0.bits() >> 56) as u8).collect();
        Image { width, height, rgb, mask: None }
    }

    /// Returns Gaussians in view of [`camera`], with coverage roughly independent of `count`.
    pub fn scene(&mut self, count: usize, sh_degree: u32) -> Scene {
        let size = 2.0 / (count.max(1) as f32).sqrt();
        let mut scene = Scene { sh_degree, ..Scene::default() };
        for _ in 0..count {
            let depth = self.uniform(1.0, 6.0);
            scene.means.push([self.uniform(-0.5, 0.5) * depth, self.uniform(-0.5, 0.5) * depth, depth]);
            scene.scales.push([0; 3].map(|_| size * depth * self.uniform(-2.0, 0.0).exp()));
            scene.quats.push([1.0, self.uniform(-1.0, 1.0), self.uniform(-1.0, 1.0), self.uniform(-1.0, 1.0)]);
            scene.opacities.push(self.uniform(0.0, 1.0));
            for _ in 0..scene.sh_coeffs_per_gaussian() {
                let color = [0; 3].map(|_| self.uniform(-0.5, 0.5));
                scene.sh_coeffs.push(color);
            }
        }
        scene
    }
}

/// Returns a camera at the origin along z; the longer side is as wide as the distance.
pub fn camera(width: u32, height: u32) -> Camera {
    let focal = f64::from(width.max(height));
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Camera { intrinsics: Intrinsics { width, height, fx: focal, fy: focal, cx, cy }, pose: Pose::IDENTITY }
}
