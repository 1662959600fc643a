//! A scene format as its module describes it.

use std::io::Write;
use std::path::Path;

use super::{Scene, World, file::write_atomic, source::Source};
use crate::Result;

/// A scene format.
pub(super) struct Format {
    /// First bytes of its files, any of these; none where the extension alone tells it.
    pub marks: &'static [&'static [u8]],
    /// The format keeps spherical harmonics above degree 0.
    pub view_dependence: bool,
    /// Reads a scene with its values as they are.
    pub read: fn(Source<'_>) -> Result<Scene>,
    /// Reads the line of [`World::line`] in a file; none where the format has no room for it.
    pub world: Option<ReadLine>,
    /// Checks that the format can hold a scene, which is valid, and gives what writes it, with the world where it has room.
    pub write: for<'a> fn(&'a Scene, &WriteOptions, Option<&World>) -> Result<Encoder<'a>>,
}

/// Reads one line of a file.
type ReadLine = fn(&Path) -> Result<Option<String>>;

/// Writes a scene that was checked: only writing itself can fail any more.
pub(super) type Encoder<'a> = Box<dyn FnOnce(&mut dyn Write) -> std::io::Result<()> + 'a>;

impl Format {
    /// Writes a scene, whatever the path is called.
    pub fn write_file(&self, path: &Path, scene: &Scene, options: &WriteOptions, world: Option<&World>) -> Result<()> {
        scene.validate()?;
        write_atomic(path, (self.write)(scene, options, world)?)
    }
}

/// How a scene is written where its format leaves a choice.
#[derive(Clone, Copy, Debug)]
pub struct WriteOptions {
    /// Version of an SPZ: 3; 2 for older readers; 4, which is packed by zstd, for those that know only the newest.
    pub spz_version: u32,
}

impl Default for WriteOptions {
    fn default() -> Self {
        Self { spz_version: 3 }
    }
}
