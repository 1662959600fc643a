use std::io::Write;

use super::{Scene, World, source::Source};
use crate::Result;

pub(super) struct Format {
    /// Possible magic bytes; empty if only the extension decides.
    pub marks: &'static [&'static [u8]],
    /// Whether harmonics above degree 0 are stored.
    pub view_dependence: bool,
    /// Whether [`Scene::antialiased`] is stored.
    pub antialiased: bool,
    /// Order of the Gaussians in a file, if it is not the scene's.
    pub order: Option<fn(&Scene) -> Vec<usize>>,
    /// Reads a scene; callers validate its values.
    pub read: fn(Source<'_>) -> Result<Scene>,
    /// Reads the line of [`World::parse`], if the format can store a world.
    pub world: Option<ReadLine>,
    /// Prepares a valid scene, in the file's order. Errors leave the file untouched.
    pub write: for<'a> fn(&'a Scene, &SaveOptions, Option<&World>) -> Result<Encoder<'a>>,
}

type ReadLine = fn(Source<'_>) -> Result<Option<String>>;

pub(super) type Encoder<'a> = Box<dyn FnOnce(&mut dyn Write) -> std::io::Result<()> + 'a>;

/// Options for writing scenes.
#[derive(Clone, Copy, Debug)]
pub struct SaveOptions {
    /// SPZ version: 2 for older readers, 3, or 4 (zstd).
    pub spz_version: u32,
}

impl Default for SaveOptions {
    fn default() -> Self {
        Self { spz_version: 3 }
    }
}
