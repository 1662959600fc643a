use std::path::Path;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::{Pose, median, sh_rotation::sh_rotation};
use crate::{Error, Result};

/// Default near plane in world units, as in gsplat.
pub const NEAR: f32 = 0.01;
/// Spherical harmonic of degree 0, `1 / (2 sqrt(pi))`.
pub const SH_0: f32 = 0.282_094_79;
const SMALL: f64 = 0.1;
const SAMPLE: usize = 4096;

/// Returns the near plane of a scene of this extent.
pub fn near(extent: f64) -> f32 {
    // Clamped to f32's normal range.
    if extent < SMALL && extent > 0.0 { NEAR * extent.log2().floor().max(-100.0).exp2() as f32 } else { NEAR }
}

/// N 3D Gaussians. Reconstructions are in the first view's camera frame (OpenCV axes) until
/// [`Scene::place`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// `[N]` centers.
    pub means: Vec<[f32; 3]>,
    /// `[N]` standard deviations along each Gaussian's axes, linear and nonnegative.
    pub scales: Vec<[f32; 3]>,
    /// `[N]` nonzero rotations wxyz, normalized by the renderer.
    pub quats: Vec<[f32; 4]>,
    /// `[N]` opacities in 0..=1.
    pub opacities: Vec<f32>,
    /// `[N * K]` spherical harmonics coefficients as `[gaussian][k][rgb]`, `K = (sh_degree + 1)^2`.
    pub sh_coeffs: Vec<[f32; 3]>,
    /// Degree of spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Whether the scene was optimized with opacity compensation for screen-space blur
    /// (Mip-Splatting, Yu et al. 2024), which is then the renderer's default.
    pub antialiased: bool,
}

impl Scene {
    /// Highest supported degree of spherical harmonics.
    pub const MAX_SH_DEGREE: u32 = 3;

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Returns true if there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Returns `K`.
    pub fn sh_coeffs_per_gaussian(&self) -> usize {
        coeffs(self.sh_degree)
    }

    /// Returns the median distance of Gaussians from their median center, or their median size if
    /// all share one place.
    pub fn extent(&self) -> f64 {
        let step = self.len().div_ceil(SAMPLE).max(1);
        let means: Vec<DVec3> = self.means.iter().step_by(step).map(|mean| DVec3::from(mean.map(f64::from))).collect();
        let center = [0, 1, 2].map(|axis| median(means.iter().map(|mean| mean[axis])).unwrap_or(0.0));
        let center = DVec3::from_array(center);
        let distance = median(means.iter().map(|mean| mean.distance(center))).filter(|distance| *distance > 0.0);
        let size = |scales: &[f32; 3]| f64::from(scales.iter().fold(0.0f32, |most, scale| most.max(*scale)));
        distance.or_else(|| median(self.scales.iter().step_by(step).map(size))).unwrap_or(0.0)
    }

    /// Returns the near plane: [`NEAR`], less for extents below 0.1.
    pub fn near(&self) -> f32 {
        near(self.extent())
    }

    /// Appends a scene.
    ///
    /// # Panics
    /// If the degrees or `antialiased` differ.
    pub fn append(&mut self, mut other: Self) {
        let kind = |scene: &Self| (scene.sh_degree, scene.antialiased);
        assert_eq!(kind(self), kind(&other), "scenes of one degree, all antialiased or none");
        self.means.append(&mut other.means);
        self.scales.append(&mut other.scales);
        self.quats.append(&mut other.quats);
        self.opacities.append(&mut other.opacities);
        self.sh_coeffs.append(&mut other.sh_coeffs);
    }

    /// Unpacks the decoder's rows of 11 + 3 K: mean 3, scale 3, quaternion wxyz 4, opacity 1,
    /// coefficients `[K][rgb]`.
    ///
    /// # Errors
    /// [`Error::Argument`] if the degree is above 3 or the last row is incomplete.
    pub fn from_packed(packed: &[f32], sh_degree: u32) -> Result<Self> {
        check_degree(sh_degree)?;
        let width = 11 + 3 * coeffs(sh_degree);
        if !packed.len().is_multiple_of(width) {
            return Err(Error::argument("packed Gaussians", packed.len(), format!("a multiple of {width} floats")));
        }
        let count = packed.len() / width;
        let mut scene = Self { sh_degree, ..Self::with_capacity(count, coeffs(sh_degree)) };
        for row in packed.chunks_exact(width) {
            let [x, y, z, sx, sy, sz, qw, qx, qy, qz, opacity] = *row.first_chunk().expect("a row has 11 and more");
            scene.means.push([x, y, z]);
            scene.scales.push([sx, sy, sz]);
            scene.quats.push([qw, qx, qy, qz]);
            scene.opacities.push(opacity);
            scene.sh_coeffs.extend_from_slice(bytemuck::cast_slice(&row[11..]));
        }
        Ok(scene)
    }

    fn with_capacity(count: usize, coeffs: usize) -> Self {
        Self {
            means: Vec::with_capacity(count),
            scales: Vec::with_capacity(count),
            quats: Vec::with_capacity(count),
            opacities: Vec::with_capacity(count),
            sh_coeffs: Vec::with_capacity(count * coeffs),
            ..Self::default()
        }
    }

    pub(super) fn zeroed(count: usize, sh_degree: u32) -> Self {
        Self {
            means: vec![[0.0; 3]; count],
            scales: vec![[0.0; 3]; count],
            quats: vec![[0.0; 4]; count],
            opacities: vec![0.0; count],
            sh_coeffs: vec![[0.0; 3]; count * coeffs(sh_degree)],
            sh_degree,
            antialiased: false,
        }
    }

    pub(super) fn rows_mut(&mut self, start: usize) -> impl IndexedParallelIterator<Item = GaussianMut<'_>> {
        let k = self.sh_coeffs_per_gaussian();
        let fields = (
            &mut self.means[start..],
            &mut self.scales[start..],
            &mut self.quats[start..],
            &mut self.opacities[start..],
            self.sh_coeffs[k * start..].par_chunks_exact_mut(k),
        );
        fields.into_par_iter().map(|(mean, scale, quat, opacity, sh)| GaussianMut { mean, scale, quat, opacity, sh })
    }

    /// Scales the world about the origin.
    pub fn scale(&mut self, factor: f32) {
        self.means.iter_mut().chain(&mut self.scales).flatten().for_each(|value| *value *= factor);
    }

    /// Moves the scene to another world: x becomes `pose(scale x)`. Quaternions and spherical
    /// harmonics rotate, too.
    pub fn place(&mut self, scale: f64, pose: &Pose) {
        let turn = DQuat::from_mat3(&pose.rotation);
        let (harmonics, k) = (sh_rotation(&pose.rotation), self.sh_coeffs_per_gaussian());
        self.means.par_iter_mut().for_each(|mean| {
            *mean = pose.transform(scale * DVec3::from(mean.map(f64::from))).as_vec3().to_array();
        });
        self.scales.par_iter_mut().flatten().for_each(|value| *value = (f64::from(*value) * scale) as f32);
        self.quats.par_iter_mut().for_each(|quat| {
            let [w, x, y, z] = quat.map(f64::from);
            let [x, y, z, w] = (turn * DQuat::from_xyzw(x, y, z, w)).to_array();
            *quat = [w, x, y, z].map(|value| value as f32);
        });
        self.sh_coeffs.par_chunks_exact_mut(k).for_each(|coeffs| {
            let before = coeffs.to_vec();
            for (coeff, row) in coeffs.iter_mut().zip(&harmonics) {
                let sum =
                    |c: usize| before.iter().zip(row).map(|(rgb, factor)| factor * f64::from(rgb[c])).sum::<f64>();
                *coeff = std::array::from_fn(|c| sum(c) as f32);
            }
        });
    }

    /// Keeps the `count` most visible of every `group` consecutive Gaussians, such as a token's.
    /// Visibility is opacity times the two largest scales; ties keep the first.
    pub fn keep_most_visible(&mut self, group: usize, count: usize) {
        self.keep(&self.most_visible(group, count));
    }

    /// Returns the indices that [`Scene::keep_most_visible`] keeps.
    pub fn most_visible(&self, group: usize, count: usize) -> Vec<usize> {
        let visible = self.visibilities();
        let mut kept = Vec::new();
        for start in (0..self.len()).step_by(group.max(1)) {
            let mut order: Vec<usize> = (start..self.len().min(start + group.max(1))).collect();
            order.sort_by(|a, b| visible[*b].total_cmp(&visible[*a]));
            order.truncate(count);
            order.sort_unstable();
            kept.extend(order);
        }
        kept
    }

    pub(super) fn visibilities(&self) -> Vec<f32> {
        (0..self.len()).map(|i| self.opacities[i] * self.area(i)).collect()
    }

    /// Returns the product of a Gaussian's two largest scales.
    pub(super) fn area(&self, i: usize) -> f32 {
        let [x, y, z] = self.scales[i];
        (x * y).max(y * z).max(x * z)
    }

    /// Removes invalid Gaussians and returns their number.
    pub fn drop_invalid(&mut self) -> Result<usize> {
        self.check_lengths()?;
        let before = self.len();
        let valid = |i: &usize| VALUES.iter().all(|values| (values.hold)(self, *i));
        let kept: Vec<usize> = (0..before).filter(valid).collect();
        if kept.len() < before {
            self.keep(&kept);
        }
        Ok(before - kept.len())
    }

    /// Keeps the Gaussians with these indices, in this order.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn keep(&mut self, kept: &[usize]) {
        let k = self.sh_coeffs_per_gaussian();
        self.sh_coeffs = kept.iter().flat_map(|i| &self.sh_coeffs[i * k..][..k]).copied().collect();
        self.means = kept.iter().map(|i| self.means[*i]).collect();
        self.scales = kept.iter().map(|i| self.scales[*i]).collect();
        self.quats = kept.iter().map(|i| self.quats[*i]).collect();
        self.opacities = kept.iter().map(|i| self.opacities[*i]).collect();
    }

    /// Checks that array lengths agree and that all values are finite and in range.
    ///
    /// # Errors
    /// [`Error::Argument`] with the number of invalid Gaussians and the first of them.
    pub fn validate(&self) -> Result<()> {
        self.check_lengths()?;
        let n = self.len();
        for Values { field, expected, hold } in VALUES {
            let mut bad = (0..n).filter(|&i| !hold(self, i));
            if let Some(first) = bad.next() {
                let found = format!("{} of {n} Gaussians otherwise, the first is {first}", 1 + bad.count());
                return Err(Error::argument(format!("scene {field}"), found, expected));
            }
        }
        Ok(())
    }

    pub(super) fn validated(self, path: &Path) -> Result<Self> {
        self.validate().map_err(|error| Error::format(path, None, error.to_string()))?;
        Ok(self)
    }

    fn check_lengths(&self) -> Result<()> {
        check_degree(self.sh_degree)?;
        let n = self.len();
        let lengths = [
            ("scales", self.scales.len(), n),
            ("quats", self.quats.len(), n),
            ("opacities", self.opacities.len(), n),
            ("sh_coeffs", self.sh_coeffs.len(), n * self.sh_coeffs_per_gaussian()),
        ];
        for (field, found, expected) in lengths {
            if found != expected {
                return Err(Error::argument(format!("scene {field}"), found, format!("{expected} for {n} means")));
            }
        }
        Ok(())
    }
}

pub(super) struct GaussianMut<'a> {
    pub mean: &'a mut [f32; 3],
    pub scale: &'a mut [f32; 3],
    pub quat: &'a mut [f32; 4],
    pub opacity: &'a mut f32,
    pub sh: &'a mut [[f32; 3]],
}

struct Values {
    field: &'static str,
    expected: &'static str,
    hold: fn(&Scene, usize) -> bool,
}

const VALUES: [Values; 5] = [
    Values { field: "means", expected: "finite numbers", hold: |scene, i| finite(&scene.means[i]) },
    Values {
        field: "scales",
        expected: "finite numbers, none negative",
        hold: |scene, i| scene.scales[i].iter().all(|s| s.is_finite() && *s >= 0.0),
    },
    Values {
        field: "quats",
        expected: "finite numbers, not all zero",
        hold: |scene, i| finite(&scene.quats[i]) && scene.quats[i] != [0.0; 4],
    },
    Values { field: "opacities", expected: "0 to 1", hold: |scene, i| (0.0..=1.0).contains(&scene.opacities[i]) },
    Values {
        field: "sh_coeffs",
        expected: "finite numbers",
        hold: |scene, i| {
            let k = scene.sh_coeffs_per_gaussian();
            finite(scene.sh_coeffs[i * k..][..k].as_flattened())
        },
    },
];

fn finite(values: &[f32]) -> bool {
    values.iter().all(|value| value.is_finite())
}

fn coeffs(degree: u32) -> usize {
    (degree as usize + 1).pow(2)
}

fn check_degree(degree: u32) -> Result<()> {
    if degree > Scene::MAX_SH_DEGREE {
        return Err(Error::argument("sh_degree", degree, format!("0 to {}", Scene::MAX_SH_DEGREE)));
    }
    Ok(())
}
