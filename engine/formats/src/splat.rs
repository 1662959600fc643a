//! `.splat` of antimatter15's viewer, 32 bytes per Gaussian: mean 3 f32, standard deviations 3 f32,
//! color and opacity RGBA8, rotation wxyz 4 u8 centered at 128. Axes as in PLY. Color is that of
//! degree 0, clamped to 0..1.

use super::format::{Encoder, Format, SaveOptions};
use super::{SH_0, Scene, World, camera::unit_quaternion, source::Source};
use crate::{Error, Result};

pub(super) const FORMAT: Format = Format {
    marks: &[],
    view_dependence: false,
    antialiased: false,
    order: Some(order),
    read: read_unchecked,
    world: None,
    write: encoder,
};

const ROW: usize = 32;

/// The largest and most opaque Gaussians first, for progressive viewers.
fn order(scene: &Scene) -> Vec<usize> {
    let importance = |i: usize| scene.scales[i].map(f64::from).iter().product::<f64>() * f64::from(scene.opacities[i]);
    let mut order: Vec<usize> = (0..scene.len()).collect();
    order.sort_by(|&a, &b| importance(b).total_cmp(&importance(a)));
    order
}

fn encoder<'a>(scene: &'a Scene, _: &SaveOptions, _: Option<&World>) -> Result<Encoder<'a>> {
    Ok(Box::new(move |out| (0..scene.len()).try_for_each(|i| out.write_all(&encode(scene, i)))))
}

fn encode(scene: &Scene, i: usize) -> [u8; ROW] {
    let level = |value: f32| (255.0 * value).round() as u8;
    let [r, g, b] = scene.sh_coeffs[i * scene.sh_coeffs_per_gaussian()].map(|dc| level(0.5 + SH_0 * dc));
    let rotation = unit_quaternion(scene.quats[i]).map(|q| (128.0 * q + 128.0).round() as u8);
    let mut row = [0; ROW];
    row[..12].copy_from_slice(bytemuck::cast_slice(&scene.means[i].map(f32::to_le_bytes)));
    row[12..24].copy_from_slice(bytemuck::cast_slice(&scene.scales[i].map(f32::to_le_bytes)));
    row[24..28].copy_from_slice(&[r, g, b, level(scene.opacities[i])]);
    row[28..].copy_from_slice(&rotation);
    row
}

/// Quaternions keep their rounded length.
fn read_unchecked(mut source: Source<'_>) -> Result<Scene> {
    let bytes = source.rest()?;
    let (rows, rest) = bytes.as_chunks::<ROW>();
    if !rest.is_empty() {
        let reason = format!("{} bytes remain of a Gaussian, expected {ROW} for each", rest.len());
        return Err(Error::format(source.name, Some((bytes.len() - rest.len()) as u64), reason));
    }
    let mut scene = Scene::default();
    for row in rows {
        let floats: [f32; 6] =
            std::array::from_fn(|j| f32::from_le_bytes(std::array::from_fn(|byte| row[4 * j + byte])));
        let [x, y, z, sx, sy, sz] = floats;
        scene.means.push([x, y, z]);
        scene.scales.push([sx, sy, sz]);
        scene.quats.push(std::array::from_fn(|j| (f32::from(row[28 + j]) - 128.0) / 128.0));
        scene.opacities.push(f32::from(row[27]) / 255.0);
        scene.sh_coeffs.push(std::array::from_fn(|c| (f32::from(row[24 + c]) / 255.0 - 0.5) / SH_0));
    }
    Ok(scene)
}
