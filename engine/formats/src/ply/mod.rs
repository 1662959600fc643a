//! PLY of 3D Gaussian Splatting (Kerbl et al. 2023): logit opacity, log scale, channel-first
//! `f_rest_*`; and its `packed` variant.

mod packed;
mod points;
mod property;
mod table;

use std::io::Read;
use std::path::Path;

use rayon::prelude::*;

use super::format::{Encoder, Format};
use super::{
    Scene,
    file::write_atomic,
    source::Source,
    world::{MADE_BY, World},
};
use crate::{Error, Result};
use table::{Column, MAX_HEADER, Parsed, Ply, Table};

pub(super) const FORMAT: Format = Format {
    marks: &[b"ply"],
    view_dependence: true,
    antialiased: true,
    order: None,
    read: read_unchecked,
    world: Some(read_line),
    write: |scene, _, world| Ok(encoder(scene, &start(world), None)),
};

pub use points::{PointCloud, read_points, write_points};
pub use property::{PlyProperty, read_ply_property, write_ply_with};

const BATCH: usize = 1 << 16;
/// The logit is infinite at 0 and 1.
const OPACITY_MARGIN: f32 = 1e-6;
const START: &str = "ply\nformat binary_little_endian 1.0\n";
const COMMENT: &str = "comment ";
/// Brush's tag of antialiased scenes.
const ANTIALIASED: [&str; 2] = ["SplatRenderMode:", "mip"];
/// The logarithm of 0 is infinite.
const MIN_SCALE: f32 = 1e-6;

/// Writes a binary little-endian PLY of f32 properties atomically.
pub fn write_ply(scene: &Scene, path: impl AsRef<Path>) -> Result<()> {
    scene.validate()?;
    write_atomic(path.as_ref(), encoder(scene, START, None))
}

fn read_line(source: Source<'_>) -> Result<Option<String>> {
    let (path, mut start) = (source.name, Vec::new());
    source.take(MAX_HEADER as u64).read_to_end(&mut start).map_err(|error| Error::io(path, error))?;
    let header = String::from_utf8_lossy(&start);
    let mut comments = header.lines().take_while(|line| *line != "end_header").filter_map(|l| l.strip_prefix(COMMENT));
    Ok(comments.find(|comment| comment.starts_with(MADE_BY)).map(str::to_owned))
}

fn encoder<'a>(scene: &'a Scene, start: &str, last: Option<&PlyProperty<'a>>) -> Encoder<'a> {
    let mut names = property_names(scene.sh_coeffs_per_gaussian());
    names.extend(last.map(|property| property.name.to_owned()));
    let last = last.map(|property| property.values);
    let tag = if scene.antialiased { format!("{COMMENT}{}\n", ANTIALIASED.join(" ")) } else { String::new() };
    let mut header = format!("{start}{tag}element vertex {}\n", scene.len());
    for name in &names {
        header += &format!("property float {name}\n");
    }
    header += "end_header\n";
    let row = 4 * names.len();
    Box::new(move |out| {
        out.write_all(header.as_bytes())?;
        let mut rows = vec![0; row * BATCH.min(scene.len())];
        for start in (0..scene.len()).step_by(BATCH) {
            let batch = &mut rows[..row * BATCH.min(scene.len() - start)];
            batch.par_chunks_exact_mut(row).enumerate().for_each(|(i, row)| encode(scene, last, start + i, row));
            out.write_all(batch)?;
        }
        Ok(())
    })
}

fn start(world: Option<&World>) -> String {
    format!("{START}{COMMENT}{}\n", World::line(world))
}

fn property_names(coeffs: usize) -> Vec<String> {
    let numbered = |prefix: &'static str, count| (0..count).map(move |i| format!("{prefix}_{i}"));
    let fixed = |names: &[&str]| names.iter().map(ToString::to_string).collect::<Vec<_>>();
    fixed(&["x", "y", "z", "nx", "ny", "nz"])
        .into_iter()
        .chain(numbered("f_dc", 3))
        .chain(numbered("f_rest", 3 * (coeffs - 1)))
        .chain(fixed(&["opacity"]))
        .chain(numbered("scale", 3))
        .chain(numbered("rot", 4))
        .collect()
}

fn encode(scene: &Scene, last: Option<&[f32]>, i: usize, row: &mut [u8]) {
    let k = scene.sh_coeffs_per_gaussian();
    let sh = &scene.sh_coeffs[i * k..][..k];
    let opacity = scene.opacities[i].clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    let normal = [0.0; 3];
    let values = (scene.means[i].into_iter().chain(normal).chain(sh[0]))
        .chain((0..3).flat_map(|channel| sh[1..].iter().map(move |coeff| coeff[channel])))
        .chain([ln(opacity / (1.0 - opacity))])
        .chain(scene.scales[i].map(|scale| ln(scale.max(MIN_SCALE))))
        .chain(scene.quats[i])
        .chain(last.map(|values| values[i]));
    for (bytes, value) in row.chunks_exact_mut(4).zip(values) {
        bytes.copy_from_slice(&value.to_le_bytes());
    }
}

/// Rounds once from f64: files are identical on all platforms.
fn ln(value: f32) -> f32 {
    f64::from(value).ln() as f32
}

/// Reads a 3D Gaussian Splatting PLY, binary little endian or ASCII, with properties in any order
/// and type. `f_rest_*` determine the degree, 0 to 3.
pub fn read_ply(path: impl AsRef<Path>) -> Result<Scene> {
    read_unchecked(Source::open(path.as_ref())?)?.validated(path.as_ref())
}

fn read_unchecked(source: Source<'_>) -> Result<Scene> {
    let path = source.name;
    let decode = |mut ply: Ply<'_>| {
        let scene = if packed::is(&ply) { packed::decode(&mut ply) } else { decode(&mut ply) }?;
        Ok(Scene { antialiased: ply.antialiased, ..scene })
    };
    Ply::open(source).and_then(decode).map_err(|fault| fault.of(path))
}

fn decode(ply: &mut Ply<'_>) -> Parsed<Scene> {
    let table = ply.table("vertex")?;
    let column = |name: &str| table.column(name);
    let means = [column("x")?, column("y")?, column("z")?];
    let scales = [column("scale_0")?, column("scale_1")?, column("scale_2")?];
    let quats = [column("rot_0")?, column("rot_1")?, column("rot_2")?, column("rot_3")?];
    let opacity = column("opacity")?;
    let base = [column("f_dc_0")?, column("f_dc_1")?, column("f_dc_2")?];
    let (rest, sh_degree) = rest_columns(&table, column)?;
    let mut scene = Scene::zeroed(table.count, sh_degree);
    ply.rows(&table, |start, rows| {
        scene.rows_mut(start).zip(rows.par_chunks_exact(table.row_bytes)).for_each(|(gaussian, row)| {
            *gaussian.mean = read(&means, row);
            *gaussian.scale = read(&scales, row).map(f32::exp);
            *gaussian.quat = read(&quats, row);
            *gaussian.opacity = 1.0 / (1.0 + (-opacity.read(row)).exp());
            gaussian.sh[0] = read(&base, row);
            for (coeff, columns) in gaussian.sh[1..].iter_mut().zip(&rest) {
                *coeff = read(columns, row);
            }
        });
        Ok(())
    })?;
    Ok(scene)
}

fn rest_columns(table: &Table, column: impl Fn(&str) -> Parsed<Column>) -> Parsed<(Vec<[Column; 3]>, u32)> {
    let count = table.names().filter(|name| name.starts_with("f_rest_")).count();
    let Some(sh_degree) = (0..=Scene::MAX_SH_DEGREE).find(|degree| 3 * degree * (degree + 2) == count as u32) else {
        return Err(table.fault(format!("{count} f_rest properties, expected 0, 9, 24 or 45 (degree 0 to 3)")));
    };
    let coefficient = |k: usize| {
        let rest = |channel: usize| column(&format!("f_rest_{}", channel * count / 3 + k));
        Ok([rest(0)?, rest(1)?, rest(2)?])
    };
    Ok(((0..count / 3).map(coefficient).collect::<Parsed<_>>()?, sh_degree))
}

fn read<const N: usize>(columns: &[Column; N], row: &[u8]) -> [f32; N] {
    columns.map(|column| column.read(row))
}
