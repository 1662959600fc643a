use std::path::Path;

use super::super::{file::write_atomic, source::Source};
use super::table::{Parsed, Ply};
use crate::{Result, scalar::Scalar};

/// Points in the world of their cameras.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// `[N]` xyz in the file's frame and unit.
    pub positions: Vec<[f32; 3]>,
    /// `[N]` RGB; empty if the file has none.
    pub colors: Vec<[u8; 3]>,
}

impl PointCloud {
    /// Color of points without one.
    pub const GRAY: [u8; 3] = [128; 3];
}

/// Reads positions and 8-bit colors of a PLY's vertices.
pub fn read_points(path: impl AsRef<Path>) -> Result<PointCloud> {
    let path = path.as_ref();
    cloud(Source::open(path)?).map_err(|fault| fault.of(path))
}

fn cloud(source: Source<'_>) -> Parsed<PointCloud> {
    let mut ply = Ply::open(source)?;
    let table = ply.table("vertex")?;
    let at = [table.column("x")?, table.column("y")?, table.column("z")?];
    let is_byte = |name: &str| ply.declared("vertex", name) == Some(Scalar::U8);
    let color = ["red", "green", "blue"].map(|name| table.column(name).ok().filter(|_| is_byte(name)));
    let color = if let [Some(red), Some(green), Some(blue)] = color { Some([red, green, blue]) } else { None };
    let PointCloud { mut positions, mut colors } = PointCloud::default();
    ply.rows(&table, |_, rows| {
        positions.extend(rows.chunks_exact(table.row_bytes).map(|row| super::read(&at, row)));
        if let Some(color) = &color {
            let rows = rows.chunks_exact(table.row_bytes);
            colors.extend(rows.map(|row| super::read(color, row).map(|value| value as u8)));
        }
        Ok(())
    })?;
    match positions.iter().position(|point| !point.iter().all(|value| value.is_finite())) {
        Some(i) => Err(table.fault(format!("vertex {i}: found {:?}, expected finite numbers", positions[i]))),
        None => Ok(PointCloud { positions, colors }),
    }
}

/// Writes a binary little-endian PLY of positions and 8-bit colors atomically.
pub fn write_points(path: impl AsRef<Path>, points: &[([f32; 3], [u8; 3])]) -> Result<()> {
    let mut header = format!("{}element vertex {}\n", super::start(None), points.len());
    ["x", "y", "z"].iter().for_each(|name| header += &format!("property float {name}\n"));
    ["red", "green", "blue"].iter().for_each(|name| header += &format!("property uchar {name}\n"));
    header += "end_header\n";
    let rows = points.iter().flat_map(|(at, color)| at.iter().flat_map(|v| v.to_le_bytes()).chain(*color));
    let bytes: Vec<u8> = header.bytes().chain(rows).collect();
    write_atomic(path.as_ref(), |out| out.write_all(&bytes))
}
