//! Quantization of SPZ attributes.

use std::f32::consts::FRAC_1_SQRT_2;

use crate::{Error, Result};
use crate::{Scene, axes::HalfTurn::AboutX, camera::unit_quaternion};

/// Bits of a position's magnitude: 24 with sign.
pub(super) const POSITION_BITS: u32 = 23;
pub(super) const MAX_FRACTIONAL_BITS: u32 = 16;
/// Flag of antialiased scenes.
pub(super) const ANTIALIASED: u8 = 1;
/// Natural logarithm of the smallest scale, and levels per factor of e.
const MIN_LOG_SCALE: f32 = -10.0;
const LOG_SCALE_LEVELS: f32 = 16.0;
/// Leaves headroom for colors outside 0..1.
const COLOR_SCALE: f32 = 0.15;
/// Levels per bucket of degree 1 and higher: fewer distinct bytes compress better.
const SH_BUCKETS: [i32; 2] = [8, 16];
/// Largest component magnitude in versions 3 and 4; represents `1 / sqrt(2)`.
const SMALLEST_THREE_MAX: f32 = 511.0;

/// Section layout: positions, opacities, colors, scales, rotations, spherical harmonics above
/// degree 0.
pub(super) struct Layout {
    pub version: u32,
    pub sh_degree: u32,
    pub fractional_bits: u32,
    pub antialiased: bool,
}

pub(super) fn fractional_bits(scene: &Scene) -> Result<u32> {
    let farthest = scene.means.iter().flatten().fold(0f32, |farthest, value| farthest.max(value.abs()));
    let limit = (1 << POSITION_BITS) as f32 - 1.0;
    let fits = |bits: &u32| (farthest * (1u32 << bits) as f32).round() <= limit;
    (0..=MAX_FRACTIONAL_BITS).rev().find(fits).ok_or_else(|| {
        Error::argument(
            "scene means",
            format!("a coordinate of magnitude {farthest}"),
            format!("up to {limit} in an SPZ"),
        )
    })
}

impl Layout {
    fn rotation_bytes(&self) -> usize {
        if self.version == 2 { 3 } else { 4 }
    }

    fn rest(&self) -> usize {
        (self.sh_degree as usize + 1).pow(2) - 1
    }

    /// Degree, fractional bits and flags, as in headers.
    pub(super) fn fields(&self) -> [u8; 3] {
        [self.sh_degree as u8, self.fractional_bits as u8, ANTIALIASED * u8::from(self.antialiased)]
    }

    pub(super) fn section_bytes(&self) -> [usize; 6] {
        [9, 1, 3, 3, self.rotation_bytes(), 3 * self.rest()]
    }

    pub(super) fn gaussian_bytes(&self) -> usize {
        self.section_bytes().iter().sum()
    }

    pub(super) fn encode(
        &self,
        scene: &Scene,
        mut write: impl FnMut(Vec<u8>) -> std::io::Result<()>,
    ) -> std::io::Result<()> {
        let k = scene.sh_coeffs_per_gaussian();
        let one = (1u32 << self.fractional_bits) as f32;
        let fixed = |value: f32| ((value * one).round() as i32).to_le_bytes().into_iter().take(3);
        let positions = scene.means.iter().flat_map(|&mean| AboutX.point(mean)).flat_map(fixed);
        write(positions.collect())?;
        write(scene.opacities.iter().map(|opacity| byte(255.0 * opacity)).collect())?;
        let colors = scene.sh_coeffs.iter().step_by(k).flatten();
        write(colors.map(|dc| byte(255.0 * (COLOR_SCALE * dc + 0.5))).collect())?;
        let scales = scene.scales.iter().flatten();
        write(scales.map(|scale| byte(LOG_SCALE_LEVELS * (scale.ln() - MIN_LOG_SCALE))).collect())?;
        let rotations = scene.quats.iter().map(|&quat| unit_quaternion(AboutX.quat(quat)));
        if self.version == 2 {
            write(rotations.flat_map(first_three).collect())?;
        } else {
            write(rotations.flat_map(smallest_three).collect())?;
        }
        let rest = scene.sh_coeffs.iter().enumerate().filter(|(i, _)| i % k != 0);
        let level = |(i, rgb): (usize, &[f32; 3])| rgb.map(|value| sh_level(AboutX.sh(i % k) * value, i % k));
        write(rest.flat_map(level).collect())
    }

    pub(super) fn decode(&self, body: &[u8], count: usize) -> Scene {
        let mut rest = body;
        let mut section = |bytes: usize| {
            let (section, after) = rest.split_at(count * bytes);
            rest = after;
            section
        };
        let [positions, alphas, colors, scales] = [9, 1, 3, 3].map(&mut section);
        let (rotations, sh) = (section(self.rotation_bytes()), section(3 * self.rest()));
        let one = (1u32 << self.fractional_bits) as f32;
        let fixed = |b: &[u8; 3]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 / one;
        let triples = |bytes| <[u8]>::as_chunks::<3>(bytes).0;
        let quats = if self.version == 2 {
            triples(rotations).iter().map(from_first_three).map(|quat| AboutX.quat(quat)).collect()
        } else {
            rotations.as_chunks().0.iter().map(from_smallest_three).map(|quat| AboutX.quat(quat)).collect()
        };
        let mut sh_coeffs = Vec::with_capacity(count * (self.rest() + 1));
        for (i, color) in triples(colors).iter().enumerate() {
            sh_coeffs.push(color.map(|level| (f32::from(level) / 255.0 - 0.5) / COLOR_SCALE));
            let levels = &triples(sh)[i * self.rest()..][..self.rest()];
            let coeff =
                |(k, rgb): (usize, &[u8; 3])| rgb.map(|level| AboutX.sh(k + 1) * (f32::from(level) - 128.0) / 128.0);
            sh_coeffs.extend(levels.iter().enumerate().map(coeff));
        }
        Scene {
            means: triples(positions)
                .as_chunks()
                .0
                .iter()
                .map(|point| AboutX.point(point.each_ref().map(fixed)))
                .collect(),
            scales: (triples(scales).iter())
                .map(|levels| levels.map(|level| (f32::from(level) / LOG_SCALE_LEVELS + MIN_LOG_SCALE).exp()))
                .collect(),
            quats,
            opacities: alphas.iter().map(|&level| f32::from(level) / 255.0).collect(),
            sh_coeffs,
            sh_degree: self.sh_degree,
            antialiased: self.antialiased,
        }
    }
}

fn byte(value: f32) -> u8 {
    value.round() as u8
}

/// Quantizes coefficient `k` to its bucket's center; 128 represents 0, 128 levels represent 1.
fn sh_level(value: f32, k: usize) -> u8 {
    let bucket = if k < 4 { SH_BUCKETS[0] } else { SH_BUCKETS[1] };
    let level = (128.0 * value).round().clamp(-256.0, 256.0) as i32 + 128;
    (level + bucket / 2).div_euclid(bucket).saturating_mul(bucket).clamp(0, 255) as u8
}

/// Version 2: x, y, z of the quaternion with w >= 0.
fn first_three([w, x, y, z]: [f32; 4]) -> [u8; 3] {
    let half = if w < 0.0 { -127.5 } else { 127.5 };
    [x, y, z].map(|q| byte(half * q + 127.5))
}

fn from_first_three(levels: &[u8; 3]) -> [f32; 4] {
    let [x, y, z] = levels.map(|level| f32::from(level) / 127.5 - 1.0);
    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
}

/// Versions 3 and 4: 2 bits for the largest of x, y, z, w, which is made positive and omitted, then
/// sign and 9-bit magnitude of the others.
fn smallest_three([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let quat = [x, y, z, w];
    let largest = (1..4).fold(0, |best, i| if quat[i].abs() > quat[best].abs() { i } else { best });
    let mut bits = largest as u32;
    for i in (0..4).filter(|&i| i != largest) {
        let negative = (quat[i] < 0.0) != (quat[largest] < 0.0);
        let magnitude = (SMALLEST_THREE_MAX * quat[i].abs() / FRAC_1_SQRT_2).round().min(SMALLEST_THREE_MAX);
        bits = bits << 10 | u32::from(negative) << 9 | magnitude as u32;
    }
    bits.to_le_bytes()
}

fn from_smallest_three(bytes: &[u8; 4]) -> [f32; 4] {
    let mut bits = u32::from_le_bytes(*bytes);
    let largest = (bits >> 30) as usize;
    let mut quat = [0f32; 4];
    for i in (0..4).rev().filter(|&i| i != largest) {
        let magnitude = (bits & 511) as f32 / SMALLEST_THREE_MAX * FRAC_1_SQRT_2;
        quat[i] = if bits >> 9 & 1 == 1 { -magnitude } else { magnitude };
        bits >>= 10;
    }
    quat[largest] = (1.0 - quat.iter().map(|q| q * q).sum::<f32>()).max(0.0).sqrt();
    let [x, y, z, w] = quat;
    [w, x, y, z]
}
