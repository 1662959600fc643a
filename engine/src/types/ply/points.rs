//! Point clouds: positions and colours, as structure from motion leaves them.

use std::path::Path;

use super::super::{file::write_atomic, source::Source};
use super::table::{Parsed, Ply};
use crate::Result;

/// Reads the positions of a PLY's vertices, in the file's frame and unit.
///
/// # Errors
/// [`Error::Io`](crate::Error::Io) when the file cannot be read; [`Error::Format`](crate::Error::Format) when it is
/// truncated, lacks x, y or z, or holds values that are not finite.
pub fn read_points(path: impl AsRef<Path>) -> Result<Vec<[f32; 3]>> {
    let path = path.as_ref();
    positions(Source::open(path)?).map_err(|fault| fault.of(path))
}

fn positions(source: Source<'_>) -> Parsed<Vec<[f32; 3]>> {
    let mut ply = Ply::open(source)?;
    let table = ply.table("vertex")?;
    let columns = [table.column("x")?, table.column("y")?, table.column("z")?];
    let mut points: Vec<[f32; 3]> = Vec::new();
    ply.rows(&table, |_, rows| {
        points.extend(rows.chunks_exact(table.row_bytes).map(|row| super::read(&columns, row)));
        Ok(())
    })?;
    match points.iter().position(|point| !point.iter().all(|value| value.is_finite())) {
        Some(i) => Err(table.fault(format!("vertex {i}: found {:?}, expected finite numbers", points[i]))),
        None => Ok(points),
    }
}

/// Writes positions and 8-bit colours as a binary little-endian PLY; the file appears whole or not at all.
///
/// # Errors
/// [`Error::Io`](crate::Error::Io) when the file cannot be written.
pub fn write_points(path: impl AsRef<Path>, points: &[([f32; 3], [u8; 3])]) -> Result<()> {
    let mut header = format!("{}element vertex {}\n", super::start(None), points.len());
    ["x", "y", "z"].iter().for_each(|name| header += &format!("property float {name}\n"));
    ["red", "green", "blue"].iter().for_each(|name| header += &format!("property uchar {name}\n"));
    header += "end_header\n";
    let rows = points.iter().flat_map(|(at, color)| at.iter().flat_map(|v| v.to_le_bytes()).chain(*color));
    let bytes: Vec<u8> = header.bytes().chain(rows).collect();
    write_atomic(path.as_ref(), |out| out.write_all(&bytes))
}
