//! Splat gradients summed over tiles, then color gradients to coefficients and centers.

use super::added_to;
use crate::prelude::*;
use glam::DVec3;
use zipsplat::{
    kernels::render::ColorBackward,
    stages::render::camera_rows,
    types::{Camera, Pose},
};
use zipsplat_reference::render::backward::of_color;

const REASON: &str = "gamma_n of a sum over n tiles; harmonics have slopes of at most 2.6 on the sphere, and their polynomials values, \
    slopes and second slopes of at most 1.5, 5 and 12, which the rounding of the direction and of 40 operations moves";

/// Moments, red, green, blue, depth.
const VALUES: usize = 10;
const BEFORE: f32 = 0.5;
const SLOPE: f64 = 5.0;
const SECOND_SLOPE: f64 = 12.0;
/// Direction error: an offset and its normalization.
const OFF: f64 = 12.0 * ULP;

/// Gaussians in front of one camera with given tile counts.
struct Problem {
    degree: u32,
    camera: Camera,
    means: Vec<[f32; 3]>,
    coeffs: Vec<f32>,
    colors: Vec<[f32; 3]>,
    /// `[N + 1]`.
    starts: Vec<u32>,
    /// `[slots, VALUES]`.
    slots: Vec<f32>,
    /// Intersections exceed the capacity.
    full: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    Unwritten,
    LastTile,
    /// Gradients of colors clamped at 0.
    Unheld,
    NoBands,
    Overwritten,
    /// No center gradient through color.
    NoDirection,
    NeighborGaussian,
    FullCounts,
}

impl Problem {
    fn new(count: usize, degree: u32, tiles: impl Fn(usize) -> u32) -> Self {
        let mut noise = Noise::new(count as u64 + u64::from(degree));
        let scene = noise.scene(count, degree);
        let mut starts = vec![0];
        (0..count).for_each(|i| starts.push(starts[i] + tiles(i)));
        let slots = noise.values(starts[count] as usize * VALUES);
        let color = |i: usize| [0, 1, 2].map(|c| if (i + c).is_multiple_of(4) { 0.0 } else { 0.5 });
        Self {
            degree,
            camera: Camera { pose: Pose::IDENTITY, ..camera(64, 64) },
            means: scene.means,
            coeffs: scene.sh_coeffs.as_flattened().to_vec(),
            colors: (0..count).map(color).collect(),
            starts,
            slots,
            full: false,
        }
    }

    fn moved(mut self, by: DVec3) -> Self {
        self.camera.pose.translation += by;
        for mean in &mut self.means {
            *mean = (DVec3::from(mean.map(f64::from)) + by).as_vec3().to_array();
        }
        self
    }

    fn bases(&self) -> usize {
        (self.degree as usize + 1).pow(2)
    }

    /// Sums slots and their magnitudes, and counts slots.
    fn sum(&self, n: usize, fault: Option<Fault>) -> ([f64; VALUES], [f64; VALUES], usize) {
        let (mut sum, mut magnitudes) = ([0.0; VALUES], [0.0; VALUES]);
        if self.full && fault != Some(Fault::FullCounts) {
            return (sum, magnitudes, 0);
        }
        let (first, mut end) = (self.starts[n] as usize, self.starts[n + 1] as usize);
        if fault == Some(Fault::LastTile) {
            end = end.max(first + 1) - 1;
        }
        for slot in self.slots[first * VALUES..end * VALUES].chunks(VALUES) {
            for (i, value) in slot.iter().enumerate() {
                sum[i] += f64::from(*value);
                magnitudes[i] += f64::from(value.abs());
            }
        }
        (sum, magnitudes, end - first)
    }

    fn gradient(&self, n: usize, fault: Option<Fault>) -> (Vec<f64>, Vec<f64>) {
        let (mut sum, ..) = self.sum(n, fault);
        let width = 3 * self.bases();
        let coeffs = widen(&self.coeffs[n * width..][..width]);
        let held = |c: usize| self.colors[n][c] <= 0.0 && fault != Some(Fault::Unheld);
        let d = [0, 1, 2].map(|c| if held(c) { 0.0 } else { sum[6 + c] });
        let offset = DVec3::from(self.means[n].map(f64::from)) - self.camera.pose.translation;
        let (mut of_coeffs, mut of_offset) = of_color(&coeffs, offset, d);
        match fault {
            Some(Fault::NoBands) => of_coeffs[3..].fill(0.0),
            Some(Fault::NoDirection) => of_offset = [0.0; 3],
            _ => {}
        }
        sum[6..9].copy_from_slice(&of_offset);
        let before = if fault == Some(Fault::Overwritten) { 0.0 } else { f64::from(BEFORE) };
        (sum.to_vec(), of_coeffs.into_iter().map(|d| d + before).collect())
    }

    fn all(&self, fault: Option<Fault>) -> Vec<f64> {
        let (pairs, coeffs): (Vec<_>, Vec<_>) = (0..self.means.len()).map(|n| self.gradient(n, fault)).unzip();
        [pairs.concat(), coeffs.concat()].concat()
    }

    fn errors(&self, n: usize) -> (Vec<f64>, Vec<f64>) {
        let (sum, magnitudes, count) = self.sum(n, None);
        let mut pair = magnitudes.map(|magnitude| gamma(count) * magnitude);
        let width = 3 * self.bases();
        let coeffs = &self.coeffs[n * width..][..width];
        let held = |c: usize| self.colors[n][c] <= 0.0;
        let d = [0, 1, 2]
            .map(|c| if held(c) { Bounded::exact(0.0) } else { Bounded { value: sum[6 + c], error: pair[6 + c] } });
        // Up to 20 roundings in a basis function.
        let basis = 2.6 * OFF + 20.0 * U * 1.5;
        let of_coeff = |i: usize| {
            let moved = d[i % 3].error * 1.5 + (d[i % 3].value.abs() + d[i % 3].error) * if i < 3 { U } else { basis };
            moved + 2.0 * U * (f64::from(BEFORE) + 1.5 * d[i % 3].value.abs())
        };
        let of_coeffs = (0..width).map(of_coeff).collect();
        let weights = coeffs.chunks(3).skip(1).map(|k| Bounded::dot([0, 1, 2].map(|c| Bounded::exact(k[c])), d));
        let (value, error) = weights.fold((0.0, 0.0), |(value, error), w| (value + w.value.abs(), error + w.error));
        let offset = DVec3::from(self.means[n].map(f64::from)) - self.camera.pose.translation;
        // Removing the radial part counts twice, followed by two divisions.
        let turned = 2.0 * (SLOPE * error + (SECOND_SLOPE * OFF + 40.0 * U * SLOPE) * (value + error));
        pair[6..9].fill(turned / offset.length());
        (pair.to_vec(), of_coeffs)
    }
}

impl Values for Problem {
    type Fault = Fault;

    fn compute(&self, device: &Device, _: Mode) -> Result<Vec<f32>> {
        let (mut trial, count) = (Trial::new(device), self.means.len());
        let part = |from: usize, to: usize| {
            self.slots.chunks(VALUES).flat_map(|slot| slot[from..to].to_vec()).collect::<Vec<f32>>()
        };
        let drawn = self.starts[count];
        let status = [drawn, drawn + u32::from(self.full), 0];
        let d_pairs = trial.output::<[f32; VALUES]>(count);
        let d_sh_coeffs = added_to(&mut trial, self.coeffs.len(), BEFORE);
        // Bindings cannot be empty.
        let or_some = |values: Vec<f32>| if values.is_empty() { vec![f32::NAN; VALUES] } else { values };
        let kernel = ColorBackward {
            means: trial.input(&self.means),
            sh_coeffs: trial.input(&self.coeffs),
            cameras: trial.input(&[camera_rows(&self.camera)]),
            colors: trial.input(&self.colors),
            status: trial.input(&status),
            slots: trial.input(&self.starts),
            moments: trial.input(&or_some(part(0, 6))),
            d_values: trial.input(&or_some(part(6, VALUES))),
            d_pairs,
            d_sh_coeffs,
            gaussians: count as u32,
            camera_count: 1,
            color: true,
            depth: true,
            sh_degree: self.degree,
            scene_gradients: true,
        };
        trial.rec.dispatch(kernel, count);
        Ok(trial.results([d_pairs, d_sh_coeffs])?.concat())
    }

    fn truth(&self, _: Mode) -> [Vec<f64>; 2] {
        let (pairs, coeffs): (Vec<_>, Vec<_>) = (0..self.means.len()).map(|n| self.errors(n)).unzip();
        [self.all(None), [pairs.concat(), coeffs.concat()].concat()]
    }

    fn faulty(&self, truth: &[f64], fault: Fault) -> Vec<f64> {
        let (pairs, coeffs) = truth.split_at(self.means.len() * VALUES);
        match fault {
            Fault::Unwritten => vec![f64::NAN; truth.len()],
            Fault::NeighborGaussian => [&shifted(pairs, VALUES), coeffs].concat(),
            _ => self.all(Some(fault)),
        }
    }
}

fn few(i: usize) -> u32 {
    (i % 5) as u32
}

pub fn area() -> Area {
    use Fault::*;
    let mut area = Area::new("render/color_backward", "Gaussians", Mode::ONLY_EXACT, REASON);
    let seen = || Catches::from([Unwritten, LastTile, Unheld, Overwritten, NeighborGaussian]);
    let banded = || seen().and(&[NoBands, NoDirection]);
    area.add("random, degree 0", 129, seen(), || Problem::new(129, 0, few));
    area.add("random, degree 1", 65, banded(), || Problem::new(65, 1, few));
    area.add("random, degree 2", 65, banded(), || Problem::new(65, 2, few));
    area.add("random, degree 3", 300, banded(), || Problem::new(300, 3, few));
    let many = [Unwritten, Unheld, Overwritten, NeighborGaussian];
    area.add("over 20,000 tiles", 3, many, || Problem::new(3, 1, |_| 20_000));
    area.add("scene and camera 1e6 off", 65, banded(), || {
        let near = Problem::new(65, 3, |_| 2);
        // Exact f32 offsets.
        let coarse = |mean: [f32; 3]| mean.map(|x| (x * 4.0).round() / 4.0 + 0.25);
        Problem { means: near.means.iter().map(|mean| coarse(*mean)).collect(), ..near }.moved(DVec3::splat(1e6))
    });
    area.add("nothing visible", 65, [Unwritten, Overwritten], || Problem::new(65, 1, |_| 0));
    area.add("no room for intersections", 65, [FullCounts, Overwritten], || Problem {
        full: true,
        ..Problem::new(65, 1, |_| 3)
    });
    area
}
