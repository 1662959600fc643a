//! Truth by the f64 reference, bounds by running error analysis of the kernels' formulas.

use crate::bound::{Bounded, U, ULP};
use glam::DVec3;
use rayon::prelude::*;
use zipsplat::types::{Camera, Scene};
use zipsplat_reference::render::{
    project::{self, EPS_2D, Gaussians, MIN_ALPHA},
    rasterize::{self, MAX_ALPHA, MIN_TRANSMITTANCE, Rendering},
};

/// As in kernels/shared/splat.glsl and kernels/render/project.comp.
const FAR_OFF: f64 = 256.0;
const LONG: f64 = 1e8;

/// Bounds of red, green, blue, alpha, depth.
pub type PixelBounds = [f64; 5];

struct Splat {
    place: [Bounded; 2],
    /// Row where `place.x` lies on the ridge, if not the center's.
    row: Option<f64>,
    /// Inverse covariance as squares: A, k, P.
    conic: [Bounded; 3],
    opacity: Bounded,
    color: [Bounded; 3],
    depth: Bounded,
}

pub fn truth(scene: &Scene, camera: &Camera, antialiased: bool) -> Rendering {
    rasterize::render(&gaussians(scene), &reference_camera(camera), antialiased, [0.0; 3])
}

pub fn gaussians(scene: &Scene) -> Gaussians {
    Gaussians {
        means: scene.means.iter().map(|v| v.map(f64::from)).collect(),
        quats: scene.quats.iter().map(|v| v.map(f64::from)).collect(),
        scales: scene.scales.iter().map(|v| v.map(f64::from)).collect(),
        opacities: scene.opacities.iter().map(|&v| v.into()).collect(),
        sh_coeffs: scene.sh_coeffs.as_flattened().iter().map(|&v| v.into()).collect(),
    }
}

pub fn reference_camera(camera: &Camera) -> project::Camera {
    let (view, i) = (camera.view_matrix().transpose().to_cols_array(), &camera.intrinsics);
    let k = i.matrix().transpose().to_cols_array();
    project::Camera::new(&view, &k, [i.width as usize, i.height as usize])
}

/// Returns the bounds of [`truth`], row-major.
pub fn bounds(scene: &Scene, camera: &Camera, antialiased: bool) -> Vec<PixelBounds> {
    let seen = project::project(&gaussians(scene), &reference_camera(camera), antialiased);
    let mut splats: Vec<(f64, Splat)> = Vec::new();
    for (n, reference) in seen.iter().enumerate() {
        if let Some(reference) = reference {
            splats.push((reference.depth, splat(scene, n, camera, antialiased, reference.color)));
        }
    }
    splats.sort_by(|a, b| (a.0 as f32).total_cmp(&(b.0 as f32)));
    let width = camera.intrinsics.width as usize;
    let pixel = |i: usize| pixel(&splats, [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5]);
    (0..width * camera.intrinsics.height as usize).into_par_iter().map(pixel).collect()
}

/// A Gaussian before a camera, as in kernels/render/project.comp.
pub struct Seen {
    /// Center, camera space.
    pub p: [Bounded; 3],
    pub focal: [Bounded; 2],
    pub principal: [Bounded; 2],
    /// Slopes to the center, and as the borders clamp them.
    pub free: [Bounded; 2],
    pub slope: [Bounded; 2],
    /// Axes, camera space, and by their length in pixels.
    pub axes: [[Bounded; 3]; 3],
    pub along: [[Bounded; 3]; 2],
}

impl Seen {
    pub fn new(scene: &Scene, n: usize, camera: &Camera) -> Self {
        let view = |r: usize, c: usize| Bounded::rounded(camera.pose.rotation.col(r)[c]);
        let offset = offset(scene, n, camera);
        let p = [0, 1, 2].map(|r| Bounded::dot([0, 1, 2].map(|c| view(r, c)), offset));
        let i = &camera.intrinsics;
        let (focal, principal) = ([i.fx, i.fy].map(Bounded::rounded), [i.cx, i.cy].map(Bounded::rounded));
        let size = [i.width, i.height].map(Bounded::exact);
        let free = [0, 1].map(|a| p[a] / p[2]);
        let slope = [0, 1].map(|a| {
            let margin = Bounded::rounded(0.15) * size[a] / focal[a];
            let low = -principal[a] / focal[a] - margin;
            free[a].max(low).min((size[a] - principal[a]) / focal[a] + margin)
        });
        let axes = axes(scene.quats[n], view);
        let along = [0, 1].map(|a| [0, 1, 2].map(|c| focal[a] / p[2] * (axes[a][c] - slope[a] * axes[2][c])));
        Self { p, focal, principal, free, slope, axes, along }
    }
}

fn splat(scene: &Scene, n: usize, camera: &Camera, antialiased: bool, color: [f64; 3]) -> Splat {
    let Seen { p, focal, principal, along, .. } = Seen::new(scene, n, camera);
    let (i, scales) = (&camera.intrinsics, scene.scales[n].map(Bounded::exact));
    let spread = |a: usize| [0, 1, 2].map(|c| along[a][c] * scales[c]);
    let (mut u, mut v, mut unit) = (spread(0), spread(1), None);
    let longest = Bounded::dot(u, u).max(Bounded::dot(v, v)).sqrt();
    if longest.value > LONG {
        let by = Bounded::exact(1.0) / longest;
        (u, v, unit) = (u.map(|x| x * by), v.map(|x| x * by), Some(by * by));
    }
    let scaled = |x: Bounded| unit.map_or(x, |unit| x * unit);
    let minors = [[1, 2], [2, 0], [0, 1]].map(|[a, b]| u[a] * v[b] - u[b] * v[a]);
    let (blur, sharp) = (scaled(Bounded::rounded(EPS_2D)), Bounded::dot(minors, minors));
    let trace = Bounded::dot(u, u) + Bounded::dot(v, v);
    let det = sharp + blur * trace + blur * blur;
    let (xy, yy) = (Bounded::dot(u, v), Bounded::dot(v, v) + blur);
    let place = [0, 1].map(|a| focal[a] * p[a] / p[2] + principal[a]);
    let beyond = far_off(place, [i.width, i.height].map(f64::from));
    // v v + EPS_2D of the more precise v, when the place is on the ridge: a few roundings.
    let yy = if beyond == [false; 2] { yy } else { Bounded { value: yy.value, error: 24.0 * U * yy.value } };
    let opacity = Bounded::exact(scene.opacities[n]);
    let splat = Splat {
        place,
        row: None,
        conic: [scaled(yy / det), xy / yy, scaled(Bounded::exact(1.0) / yy)],
        opacity: if antialiased { opacity * (sharp / det).sqrt() } else { opacity },
        color: colors(scene, n, color),
        depth: p[2],
    };
    if beyond == [false; 2] { splat } else { ridge(splat, beyond[1].then_some(f64::from(i.height))) }
}

/// The kernel stores the center as two numbers.
fn offset(scene: &Scene, n: usize, camera: &Camera) -> [Bounded; 3] {
    [0, 1, 2].map(|c| {
        let center = camera.pose.translation[c];
        let coarse = Bounded::exact(scene.means[n][c]) - Bounded::exact(center as f32);
        coarse - Bounded::rounded(center - f64::from(center as f32))
    })
}

/// Near the threshold the splat keeps the larger bound.
fn far_off(place: [Bounded; 2], size: [f64; 2]) -> [bool; 2] {
    [0, 1].map(|a| {
        let Bounded { value, error } = place[a];
        (-value).max(value - size[a]) - error > FAR_OFF
    })
}

/// Mirrors kernels/shared/ridge.glsl: double precision, rounded result. `height` is set for a row
/// outside the picture.
fn ridge(splat: Splat, height: Option<f64>) -> Splat {
    let ([x, y], [a, k, p]) = (splat.place.map(|at| at.value), splat.conic);
    let row = height.map(|height| y.clamp(0.0, height));
    let rise = row.map_or(0.0, |row| row - y);
    let again = |value: f64, from: f64| Bounded { error: U * value.abs() + from * (-40f64).exp2(), value };
    Splat {
        place: [again(x + k.value * rise, x.abs() + (k.value * rise).abs()), again(y, y.abs())],
        row,
        conic: [a, again(k.value, k.value.abs()), p],
        ..splat
    }
}

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

/// A basis function of band l has a slope of at most `sqrt((2l + 1) l (l + 1) / 4 pi)`, here 2.6,
/// and a value of at most 1.5. The direction's error is two roundings of an offset and its
/// normalization.
fn colors(scene: &Scene, n: usize, color: [f64; 3]) -> [Bounded; 3] {
    let off = 12.0 * ULP;
    let k = scene.sh_coeffs_per_gaussian();
    let coeffs = &scene.sh_coeffs[n * k..][..k];
    std::array::from_fn(|c| {
        let higher: f64 = coeffs[1..].iter().map(|rgb| f64::from(rgb[c]).abs()).sum();
        let all = higher + f64::from(coeffs[0][c]).abs();
        // Up to 20 roundings in a basis function, and in the sum.
        Bounded { value: color[c], error: 2.6 * off * higher + 40.0 * U * (0.5 + 1.5 * all) }
    })
}

/// Blending state, as in kernels/render/rasterize.comp.
struct Pixel {
    rgb: [Bounded; 3],
    depth: Bounded,
    left: Bounded,
}

impl Pixel {
    /// An optional contribution of `weight` widens the bounds.
    fn allow(&mut self, weight: f64, color: [f64; 3], depth: f64) {
        self.rgb.iter_mut().zip(color).for_each(|(sum, color)| sum.error += weight * color);
        self.depth.error += weight * depth;
        self.left.error += weight;
    }

    fn most(&self) -> f64 {
        self.left.value + self.left.error
    }
}

/// Near a threshold, allows both outcomes.
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
            pixel.allow((alpha.value + alpha.error) * pixel.most(), splat.color.map(high), high(splat.depth));
        }
        if alpha.value < MIN_ALPHA {
            continue;
        }
        let after = pixel.left * (Bounded::exact(1.0) - alpha);
        if (after.value - MIN_TRANSMITTANCE).abs() <= after.error {
            // Uncertain termination: later splats may contribute.
            let behind = || splats[at..].iter().map(|(_, splat)| splat);
            let color = behind().flat_map(|s| s.color).map(high).fold(0.0, f64::max);
            pixel.allow(pixel.most(), [color; 3], behind().map(|s| high(s.depth)).fold(0.0, f64::max));
        }
        if after.value <= MIN_TRANSMITTANCE {
            break;
        }
        let weight = alpha * pixel.left;
        for (sum, color) in pixel.rgb.iter_mut().zip(splat.color) {
            *sum = *sum + weight * color;
        }
        pixel.depth = pixel.depth + weight * splat.depth;
        pixel.left = pixel.left * (Bounded::exact(1.0) - alpha);
    }
    let alpha = Bounded::exact(1.0) - pixel.left;
    [pixel.rgb[0].error, pixel.rgb[1].error, pixel.rgb[2].error, alpha.error, pixel.depth.error]
}

fn alpha(splat: &Splat, place: [f64; 2]) -> Bounded {
    let [dx, dy] = [0, 1].map(|a| Bounded::exact(place[a]) - splat.place[a]);
    let [a, k, p] = splat.conic;
    let half = Bounded::rounded(-0.5 * std::f64::consts::LOG2_E);
    let across = dx - k * splat.row.map_or(dy, |row| Bounded::rounded(place[1] - row));
    let exponent = a * half * across * across + p * half * dy * dy;
    (splat.opacity * exponent.exp2()).min(Bounded::rounded(MAX_ALPHA))
}

/// Depths are exact or far enough apart in f32.
pub fn orders_depths(scene: &Scene, camera: &Camera) -> bool {
    let forward = camera.pose.rotation.z_axis;
    let mut depths: Vec<(f64, f64)> = (scene.means.iter())
        .map(|m| DVec3::from(m.map(f64::from)) - camera.pose.translation)
        .map(|offset| (forward.dot(offset), 8.0 * U * offset.length()))
        .collect();
    depths.sort_by(|a, b| a.0.total_cmp(&b.0));
    let exact = camera.pose == zipsplat::types::Pose::IDENTITY;
    exact || depths.windows(2).all(|pair| pair[1].0 - pair[0].0 > pair[0].1 + pair[1].1)
}
