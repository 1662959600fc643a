use super::{encoder, property_names, start, table::Ply};
use crate::{Error, Result, Scene, World, file::write_atomic, source::Source};
use std::path::Path;

/// A value per Gaussian, which other programs ignore.
#[derive(Clone, Copy, Debug)]
pub struct PlyProperty<'a> {
    /// Name in the file.
    pub name: &'a str,
    /// All values.
    pub values: &'a [f32],
}

/// Writes a scene with a further property atomically.
///
/// # Errors
/// [`Error::Argument`] for an invalid scene, a name with white space or of another property, and
/// another number of values.
pub fn write_ply_with(scene: &Scene, path: &Path, world: Option<&World>, property: &PlyProperty<'_>) -> Result<()> {
    scene.validate()?;
    let PlyProperty { name, values } = property;
    let is_word = !name.is_empty() && name.chars().all(|c| c.is_ascii_graphic());
    if !is_word || property_names(scene.sh_coeffs_per_gaussian()).iter().any(|known| known == name) {
        return Err(Error::argument("PLY property", format!("{name:?}"), "a word that names no other property"));
    }
    if values.len() != scene.len() {
        let expected = format!("{}, one per Gaussian", scene.len());
        return Err(Error::argument(format!("values of {name}"), values.len(), expected));
    }
    write_atomic(path, encoder(scene, &start(world), Some(property)))
}

/// Reads a property of all Gaussians.
///
/// # Errors
/// [`Error::Format`] for another file or one without the property.
pub fn read_ply_property(path: &Path, name: &str) -> Result<Vec<f32>> {
    let read = |mut ply: Ply<'_>| {
        let table = ply.table("vertex")?;
        let column = table.column(name)?;
        let mut values = Vec::with_capacity(table.count);
        ply.rows(&table, |_, rows| {
            values.extend(rows.chunks_exact(table.row_bytes).map(|row| column.read(row)));
            Ok(())
        })?;
        Ok(values)
    };
    Ply::open(Source::open(path)?).and_then(read).map_err(|fault| fault.of(path))
}
