//! glTF 2.0 with KHR_gaussian_splatting (release candidate): a point primitive with an accessor per
//! attribute, linear scales and opacities. Converts from x left, y up, z forward.
//!
//! Reads the default scene with node transforms; buffers may be embedded, base64, or files in its
//! folder. Writes one file, lossless except for normalized quaternions.

mod buffers;
mod document;
mod write;

use glam::{DMat3, DMat4, DVec3};
use rayon::prelude::*;

use super::fault::{Fault, Parsed};
use super::format::Format;
use super::{Pose, Scene, axes::HalfTurn::AboutZ, source::Source};
use crate::{Error, Result};
use buffers::Buffers;
use document::{Document, Primitive, unpack};

pub(super) const BINARY: Format = Format {
    marks: &[b"glTF"],
    view_dependence: true,
    antialiased: false,
    order: None,
    read: read_unchecked,
    world: Some(read_line),
    write: write::binary,
};
pub(super) const TEXT: Format = Format { marks: &[], write: write::text, ..BINARY };

const EXTENSION: &str = "KHR_gaussian_splatting";
/// Relative tolerance of nodes' non-uniform scale and shear.
const SHEAR_TOLERANCE: f64 = 1e-4;

fn read_unchecked(mut source: Source<'_>) -> Result<Scene> {
    let (bytes, path) = (source.rest()?, source.name);
    let fail = |fault: Fault| fault.in_file(path);
    let (json, binary) = unpack(&bytes).map_err(fail)?;
    let document = Document::parse(json).map_err(fail)?;
    let buffers = Buffers::open(&document.buffers, binary, path, source.folder())?;
    let mut parts = Vec::new();
    let mut count = 0;
    let shown = document.visit(|primitive, to_world| {
        let part = place(read_primitive(&document, &buffers, primitive)?, to_world)?;
        count += part.len();
        if count > buffers.len() {
            let bytes = buffers.len();
            return Err(format!("nodes show {count} Gaussians from {bytes} bytes, expected fewer than bytes").into());
        }
        parts.push(part);
        Ok(())
    });
    shown.map_err(fail)?;
    let joined = parts.into_iter().map(Ok).reduce(|first, second| Scene::concat(first?, second?));
    let none = || Err(Error::format(path, None, format!("the default scene shows no primitive with {EXTENSION}")));
    joined.unwrap_or_else(none)
}

fn read_line(mut source: Source<'_>) -> Result<Option<String>> {
    let bytes = source.rest()?;
    let document = unpack(&bytes).and_then(|(json, _)| Document::parse(json)).ok();
    Ok(document.and_then(|document| document.line().map(str::to_owned)))
}

fn read_primitive(document: &Document, buffers: &Buffers, primitive: &Primitive) -> Parsed<Scene> {
    let attribute = |name: &str| {
        let accessor = primitive.attributes.get(name);
        accessor.copied().ok_or_else(|| Fault::from(format!("a primitive with {EXTENSION} lacks attribute {name}")))
    };
    let own = |name: &str| attribute(&format!("{EXTENSION}:{name}"));
    let means = buffers.values::<3>(document, attribute("POSITION")?)?;
    let count = means.len();
    if count == 0 {
        return Err(Fault::from(format!("a primitive with {EXTENSION} has no Gaussian, expected one at least")));
    }
    let checked = |name: &str, found: usize| {
        if found == count {
            Ok(())
        } else {
            Err(Fault::from(format!("{name} has {found} values, expected {count} as POSITION has")))
        }
    };
    let quats = buffers.values::<4>(document, own("ROTATION")?)?;
    let scales = buffers.values::<3>(document, own("SCALE")?)?;
    let opacities = buffers.values::<1>(document, own("OPACITY")?)?;
    checked("ROTATION", quats.len())?;
    checked("SCALE", scales.len())?;
    checked("OPACITY", opacities.len())?;
    let has = |degree: &u32| primitive.attributes.contains_key(&format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_0"));
    let sh_degree = (1..=Scene::MAX_SH_DEGREE).rev().find(has).unwrap_or(0);
    let k = (sh_degree as usize + 1).pow(2);
    let mut columns = Vec::new();
    for (degree, order) in (0..=sh_degree).flat_map(|degree| (0..=2 * degree).map(move |order| (degree, order))) {
        let name = format!("SH_DEGREE_{degree}_COEF_{order}");
        columns.push(buffers.values::<3>(document, own(&name)?)?);
        checked(&name, columns[columns.len() - 1].len())?;
    }
    let mut sh_coeffs = vec![[0.0; 3]; count * k];
    sh_coeffs.par_chunks_exact_mut(k).enumerate().for_each(|(i, row)| {
        row.iter_mut().zip(&columns).for_each(|(coeff, column)| *coeff = column[i]);
    });
    let quats = quats.into_iter().map(|[x, y, z, w]| [w, x, y, z]).collect();
    Ok(Scene { means, scales, quats, opacities: opacities.into_flattened(), sh_coeffs, sh_degree, antialiased: false })
}

fn place(mut part: Scene, to_world: &DMat4) -> Parsed<Scene> {
    if *to_world != DMat4::IDENTITY {
        transform(&mut part, to_world)?;
    }
    let k = part.sh_coeffs_per_gaussian();
    part.means.par_iter_mut().for_each(|mean| *mean = AboutZ.point(*mean));
    part.quats.par_iter_mut().for_each(|quat| *quat = AboutZ.quat(*quat));
    part.sh_coeffs.par_iter_mut().enumerate().for_each(|(i, rgb)| *rgb = rgb.map(|value| AboutZ.sh(i % k) * value));
    Ok(part)
}

fn transform(part: &mut Scene, to_world: &DMat4) -> Parsed<()> {
    let (scales, rotation, translation) = to_world.to_scale_rotation_translation();
    let scale = scales.x;
    let rigid = DMat4::from_scale_rotation_translation(DVec3::splat(scale), rotation, translation);
    if !(scale > 0.0 && rigid.is_finite() && rigid.abs_diff_eq(*to_world, SHEAR_TOLERANCE * scale)) {
        let reason =
            format!("a node's transform is {to_world}, expected a rotation, one positive scale and a translation");
        return Err(reason.into());
    }
    part.place(scale, &Pose { rotation: DMat3::from_quat(rotation), translation });
    Ok(())
}
