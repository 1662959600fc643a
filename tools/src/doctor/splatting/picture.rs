//! A picture's truth and the bound of every value of it: projection and blending once by the reference in f64, once by the
//! kernels' own formulas in running error analysis.

use super::super::bound::{Bounded, U, ULP};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use zipsplat::types::{Camera, Scene};
use zipsplat_reference::render::{
    project::{self, Gaussians, MIN_ALPHA},
    rasterise::{self, Rendering},
};

/// As kernels/shared/splat.glsl and kernels/render/project.comp have them.
const BLUR: f64 = 0.3;
const MAX_ALPHA: f64 = 0.999;
const MIN_TRANSMITTANCE: f64 = 1e-4;

/// Bounds of a pixel: red, green, blue, alpha, depth.
pub type PixelBounds = [f64; 5];

/// What the kernels keep of a Gaussian.
struct Splat {
    centre: [Bounded; 2],
    /// Inverse covariance as squares: A, k, P.
    conic: [Bounded; 3],
    opacity: Bounded,
    colour: [Bounded; 3],
    depth: Bounded,
}

/// The reference's picture.
pub fn truth(scene: &Scene, camera: &Camera, antialiased: bool) -> Rendering {
    rasterise::render(&gaussians(scene), &reference_camera(camera), antialiased, [0.0; 3])
}

/// The scene as the reference takes it.
pub fn gaussians(scene: &Scene) -> Gaussians {
    Gaussians {
        means: scene.means.iter().map(|v| v.map(f64::from)).collect(),
        quats: scene.quats.iter().map(|v| v.map(f64::from)).collect(),
        scales: scene.scales.iter().map(|v| v.map(f64::from)).collect(),
        opacities: scene.opacities.iter().map(|&v| v.into()).collect(),
        sh_coeffs: scene.sh_coeffs.as_flattened().iter().map(|&v| v.into()).collect(),
    }
}

/// The camera as the reference takes it.
pub fn reference_camera(camera: &Camera) -> project::Camera {
    let (view, i) = (camera.view_matrix().transpose().to_cols_array(), &camera.intrinsics);
    let k = i.matrix().transpose().to_cols_array();
    project::Camera::new(&view, &k, [i.width as usize, i.height as usize])
}

/// Bounds of every pixel of [`truth`], row-major.
pub fn bounds(scene: &Scene, camera: &Camera, antialiased: bool) -> Vec<PixelBounds> {
    let seen = project::project(&gaussians(scene), &reference_camera(camera), antialiased);
    let mut splats: Vec<(f64, Splat)> = Vec::new();
    for (n, reference) in seen.iter().enumerate() {
        if let Some(reference) = reference {
            splats.push((reference.depth, splat(scene, n, camera, antialiased, reference.colour)));
        }
    }
    splats.sort_by(|a, b| (a.0 as f32).total_cmp(&(b.0 as f32)));
    let width = camera.intrinsics.width as usize;
    let pixel = |i: usize| pixel(&splats, [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5]);
    (0..width * camera.intrinsics.height as usize).into_par_iter().map(pixel).collect()
}

/// kernels/render/project.comp, line by line.
fn splat(scene: &Scene, n: usize, camera: &Camera, antialiased: bool, colour: [f64; 3]) -> Splat {
    let view = camera.view_matrix();
    let mean = scene.means[n].map(Bounded::exact);
    let row = |r: usize| [0, 1, 2, 3].map(|c| Bounded::rounded(view.col(c)[r]));
    let p = [0, 1, 2].map(|r| {
        let row = row(r);
        Bounded::dot([row[0], row[1], row[2]], mean) + row[3]
    });
    let i = &camera.intrinsics;
    let focal = [i.fx, i.fy].map(Bounded::rounded);
    let principal = [i.cx, i.cy].map(Bounded::rounded);
    let size = [i.width, i.height].map(Bounded::exact);
    let slope = [0, 1].map(|a| {
        let margin = Bounded::rounded(0.15) * size[a] / focal[a];
        let low = -principal[a] / focal[a] - margin;
        (p[a] / p[2]).max(low).min((size[a] - principal[a]) / focal[a] + margin)
    });
    let axes = axes(scene.quats[n], |r, c| row(r)[c]);
    let scales = scene.scales[n].map(Bounded::exact);
    let spread = |a: usize| [0, 1, 2].map(|c| focal[a] / p[2] * (axes[a][c] - slope[a] * axes[2][c]) * scales[c]);
    let [u, v] = [spread(0), spread(1)];
    let minors = [[1, 2], [2, 0], [0, 1]].map(|[a, b]| u[a] * v[b] - u[b] * v[a]);
    let (blur, sharp) = (Bounded::rounded(BLUR), Bounded::dot(minors, minors));
    let trace = Bounded::dot(u, u) + Bounded::dot(v, v);
    let det = sharp + blur * trace + blur * blur;
    let (xy, yy) = (Bounded::dot(u, v), Bounded::dot(v, v) + blur);
    let opacity = Bounded::exact(scene.opacities[n]);
    Splat {
        centre: [0, 1].map(|a| focal[a] * p[a] / p[2] + principal[a]),
        conic: [yy / det, xy / yy, Bounded::exact(1.0) / yy],
        opacity: if antialiased { opacity * (sharp / det).sqrt() } else { opacity },
        colour: colours(scene, n, camera, colour),
        depth: p[2],
    }
}

/// The Gaussian's axes in the camera: world-to-camera times its rotation.
fn axes(quat: [f32; 4], view: impl Fn(usize, usize) -> Bounded) -> [[Bounded; 3]; 3] {
    let q = quat.map(Bounded::exact);
    let largest = Bounded::exact(quat.iter().fold(0.0f32, |most, x| most.max(x.abs())));
    let q = q.map(|x| x / largest);
    let length = Bounded::dot(q, q).sqrt();
    let [w, x, y, z] = q.map(|x| x / length);
    let (one, two) = (Bounded::exact(1.0), Bounded::exact(2.0));
    let rotation = [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ];
    [0, 1, 2].map(|r| [0, 1, 2].map(|c| Bounded::dot([0, 1, 2].map(|k| view(r, k)), [0, 1, 2].map(|k| rotation[k][c]))))
}

/// The reference's colour with its bound. A basis function of band l has a slope of at most
/// `sqrt((2l + 1) l (l + 1) / 4 pi)`, 2.6 for the bands there are, and a value of at most 1.5; the direction is off by what
/// the difference of centre and camera loses, and by its normalisation.
fn colours(scene: &Scene, n: usize, camera: &Camera, colour: [f64; 3]) -> [Bounded; 3] {
    let centre = camera.pose.translation;
    let mean = DVec3::from(scene.means[n].map(f64::from));
    let distance = (mean - centre).length();
    let off = U * (mean.length() + 2.0 * centre.length()) / distance + 8.0 * ULP;
    let k = scene.sh_coeffs_per_gaussian();
    let coeffs = &scene.sh_coeffs[n * k..][..k];
    std::array::from_fn(|c| {
        let higher: f64 = coeffs[1..].iter().map(|rgb| f64::from(rgb[c]).abs()).sum();
        let all = higher + f64::from(coeffs[0][c]).abs();
        // Up to 20 roundings in a basis function, as many in the sum.
        Bounded { value: colour[c], error: 2.6 * off * higher + 40.0 * U * (0.5 + 1.5 * all) }
    })
}

/// A pixel while it is blended, kernels/render/rasterise.comp.
struct Pixel {
    rgb: [Bounded; 3],
    depth: Bounded,
    left: Bounded,
}

impl Pixel {
    /// Allows that light of `weight`, of these colours and this depth, is there or not.
    fn allow(&mut self, weight: f64, colour: [f64; 3], depth: f64) {
        self.rgb.iter_mut().zip(colour).for_each(|(sum, colour)| sum.error += weight * colour);
        self.depth.error += weight * depth;
        self.left.error += weight;
    }

    /// The most that is left.
    fn most(&self) -> f64 {
        self.left.value + self.left.error
    }
}

/// Where a threshold may be met on one side or the other, both are allowed.
fn pixel(splats: &[(f64, Splat)], place: [f64; 2]) -> PixelBounds {
    let zero = Bounded::exact(0.0);
    let mut pixel = Pixel { rgb: [zero; 3], depth: zero, left: Bounded::exact(1.0) };
    let high = |b: Bounded| b.value.abs() + b.error;
    for (at, (_, splat)) in splats.iter().enumerate() {
        let alpha = alpha(splat, place);
        if alpha.value + alpha.error < MIN_ALPHA {
            continue;
        }
        if alpha.value - alpha.error < MIN_ALPHA {
            pixel.allow((alpha.value + alpha.error) * pixel.most(), splat.colour.map(high), high(splat.depth));
        }
        if alpha.value < MIN_ALPHA {
            continue;
        }
        let after = pixel.left * (Bounded::exact(1.0) - alpha);
        if (after.value - MIN_TRANSMITTANCE).abs() <= after.error {
            // It stops here or not: whatever lies behind may be drawn with the light that is left, or be missing.
            let behind = || splats[at..].iter().map(|(_, splat)| splat);
            let colour = behind().flat_map(|s| s.colour).map(high).fold(0.0, f64::max);
            pixel.allow(pixel.most(), [colour; 3], behind().map(|s| high(s.depth)).fold(0.0, f64::max));
        }
        if after.value <= MIN_TRANSMITTANCE {
            break;
        }
        let weight = alpha * pixel.left;
        for (sum, colour) in pixel.rgb.iter_mut().zip(splat.colour) {
            *sum = *sum + weight * colour;
        }
        pixel.depth = pixel.depth + weight * splat.depth;
        pixel.left = pixel.left * (Bounded::exact(1.0) - alpha);
    }
    let alpha = Bounded::exact(1.0) - pixel.left;
    [pixel.rgb[0].error, pixel.rgb[1].error, pixel.rgb[2].error, alpha.error, pixel.depth.error]
}

fn alpha(splat: &Splat, place: [f64; 2]) -> Bounded {
    let [dx, dy] = [0, 1].map(|a| Bounded::exact(place[a]) - splat.centre[a]);
    let [a, k, p] = splat.conic;
    let half = Bounded::rounded(-0.5 * std::f64::consts::LOG2_E);
    let across = dx - k * dy;
    let exponent = a * half * across * across + p * half * dy * dy;
    (splat.opacity * exponent.exp2()).min(Bounded::rounded(MAX_ALPHA))
}

/// Whether f32 is sure to order the depths as f64 does: they are far enough apart, or exact.
pub fn orders_depths(scene: &Scene, camera: &Camera) -> bool {
    let view = camera.view_matrix();
    let rotation = DMat3::from_mat4(view);
    let mut depths: Vec<(f64, f64)> = (scene.means.iter().map(|m| DVec3::from(m.map(f64::from))))
        .map(|m| ((rotation * m).z + view.w_axis.z, 8.0 * U * (m.length() + view.w_axis.length())))
        .collect();
    depths.sort_by(|a, b| a.0.total_cmp(&b.0));
    let exact = camera.pose == zipsplat::types::Pose::IDENTITY;
    exact || depths.windows(2).all(|pair| pair[1].0 - pair[0].0 > pair[0].1 + pair[1].1)
}
