//! Packed PLY of SuperSplat and PlayCanvas (`.compressed.ply`).
//!
//! Element `chunk` has the value range of 256 Gaussians. Element `vertex` has four words: position
//! and scale within the range (11, 10 and 11 bits each); a rotation (2 bits for the largest
//! component, 10 for each other); red, green, blue and opacity (8 bits each). The optional element
//! `sh` has a byte per coefficient above degree 0.

use std::f32::consts::SQRT_2;

use rayon::prelude::*;

use super::super::{SH_0, Scene};
use super::table::{Column, Parsed, Ply, Table};
use crate::scalar::Scalar;

const CHUNK: usize = 256;
/// Width of the coefficients' range, centered on 0.
const SH_RANGE: f32 = 8.0;

pub(super) fn is(ply: &Ply<'_>) -> bool {
    ply.declared("vertex", "packed_position").is_some()
}

pub(super) fn decode(ply: &mut Ply<'_>) -> Parsed<Scene> {
    let vertices = ply.table("vertex")?;
    let mut words = Vec::new();
    for name in ["packed_position", "packed_rotation", "packed_scale", "packed_color"] {
        words.push(vertices.typed(name, Scalar::U32)?);
    }
    let chunks = ply.table("chunk")?;
    if chunks.count != vertices.count.div_ceil(CHUNK) {
        let (found, count, expected) = (chunks.count, vertices.count, vertices.count.div_ceil(CHUNK));
        return Err(
            ply.fault(format!("found {found} chunks for {count} Gaussians, expected {expected}, each of {CHUNK}"))
        );
    }
    let sh = if ply.has_element("sh") { Some(ply.table("sh")?) } else { None };
    let (rest, sh_degree) = match &sh {
        Some(table) if table.count != vertices.count => {
            let (found, count) = (table.count, vertices.count);
            return Err(ply.fault(format!("found {found} rows of sh, expected one for each of {count} vertices")));
        }
        Some(table) => super::rest_columns(table, |name| table.typed(name, Scalar::U8))?,
        None => (Vec::new(), 0),
    };
    let ranges = ranges(ply, &chunks)?;
    let mut scene = Scene::zeroed(vertices.count, sh_degree);
    ply.rows(&vertices, |start, rows| {
        let gaussians = scene.rows_mut(start).zip(rows.par_chunks_exact(vertices.row_bytes)).enumerate();
        gaussians.for_each(|(i, (gaussian, row))| {
            let range = &ranges[(start + i) / CHUNK];
            let [position, rotation, scale, color] = std::array::from_fn(|i| words[i].word(row));
            *gaussian.mean = within(&range.means, thirds(position));
            *gaussian.scale = within(&range.scales, thirds(scale)).map(f32::exp);
            *gaussian.quat = quat(rotation);
            let [opacity, blue, green, red] = color.to_le_bytes().map(|level| f32::from(level) / 255.0);
            *gaussian.opacity = opacity;
            gaussian.sh[0] = within(&range.colors, [red, green, blue]).map(|value| (value - 0.5) / SH_0);
        });
        Ok(())
    })?;
    if let Some(table) = sh.filter(|_| sh_degree > 0) {
        ply.rows(&table, |start, rows| {
            let gaussians = scene.rows_mut(start).zip(rows.par_chunks_exact(table.row_bytes));
            gaussians.for_each(|(gaussian, row)| {
                for (coeff, columns) in gaussian.sh[1..].iter_mut().zip(&rest) {
                    *coeff = columns.map(|column| coefficient(column.read(row)));
                }
            });
            Ok(())
        })?;
    }
    Ok(scene)
}

struct Range {
    means: [[f32; 3]; 2],
    scales: [[f32; 3]; 2],
    colors: [[f32; 3]; 2],
}

fn ranges(ply: &mut Ply<'_>, table: &Table) -> Parsed<Vec<Range>> {
    let columns = |prefix: &str, axes: [&str; 3]| -> Parsed<[[Column; 3]; 2]> {
        let column = |end: &str, axis: &str| table.typed(&format!("{end}_{prefix}{axis}"), Scalar::F32);
        let three = |end: &str| Ok([column(end, axes[0])?, column(end, axes[1])?, column(end, axes[2])?]);
        Ok([three("min")?, three("max")?])
    };
    let (means, scales) = (columns("", ["x", "y", "z"])?, columns("scale_", ["x", "y", "z"])?);
    // Old files have no color range: it is 0..1.
    let colors = if table.names().any(|name| name == "min_r") { Some(columns("", ["r", "g", "b"])?) } else { None };
    let mut ranges = Vec::new();
    ply.rows(table, |_, rows| {
        ranges.extend(rows.chunks_exact(table.row_bytes).map(|row| {
            let read = |columns: &[[Column; 3]; 2]| columns.map(|ends| super::read(&ends, row));
            let colors = colors.as_ref().map_or([[0.0; 3], [1.0; 3]], read);
            Range { means: read(&means), scales: read(&scales), colors }
        }));
        Ok(())
    })?;
    Ok(ranges)
}

fn within([min, max]: &[[f32; 3]; 2], shares: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|axis| min[axis] * (1.0 - shares[axis]) + max[axis] * shares[axis])
}

fn fraction(word: u32, bits: u32) -> f32 {
    let most = (1 << bits) - 1;
    (word & most) as f32 / most as f32
}

/// Unpacks three fractions of 11, 10 and 11 bits, highest first.
fn thirds(word: u32) -> [f32; 3] {
    [fraction(word >> 21, 11), fraction(word >> 11, 10), fraction(word, 11)]
}

/// Unpacks a rotation wxyz: 2 bits for the index of the positive largest component, then the rest.
fn quat(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut others = [20, 10, 0].map(|shift| (fraction(word >> shift, 10) - 0.5) * SQRT_2).into_iter();
    let mut quat = [0.0; 4];
    for (place, value) in quat.iter_mut().enumerate() {
        if place != largest {
            *value = others.next().expect("three of four");
        }
    }
    quat[largest] = (1.0 - quat.iter().map(|q| q * q).sum::<f32>()).max(0.0).sqrt();
    quat
}

/// The range's ends are exact, other levels are the centers of 256 buckets.
fn coefficient(level: f32) -> f32 {
    let fraction = match level {
        0.0 => 0.0,
        255.0 => 1.0,
        level => (level + 0.5) / 256.0,
    };
    (fraction - 0.5) * SH_RANGE
}
