//! Scene files: a module and a table row per format.

use std::borrow::Cow;
use std::io::Read;
use std::path::Path;

use super::{
    Scene, World,
    file::write_atomic,
    format::{Format, SaveOptions},
    gltf, ply, sog,
    source::Source,
    splat, spz,
};
use crate::{Error, Result};

/// ".a, .b or .c".
macro_rules! listed {
    ($last:literal) => { $last };
    ($one:literal, $last:literal) => { concat!($one, " or ", $last) };
    ($first:literal, $($rest:literal),+) => { concat!($first, ", ", listed!($($rest),+)) };
}

macro_rules! formats {
    ($($(#[$doc:meta])* $name:ident $extension:literal $format:path;)*) => {
        /// Format of a scene file.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum SceneFormat {
            $($(#[$doc])* $name,)*
        }

        impl SceneFormat {
            /// Every format, in the order of messages.
            pub const ALL: &[Self] = &[$(Self::$name),*];

            /// Extensions of all formats, for messages.
            pub const EXTENSIONS: &str = listed!($($extension),*);

            /// Returns the file extension, such as ".ply".
            pub fn extension(self) -> &'static str {
                match self {
                    $(Self::$name => $extension,)*
                }
            }

            pub(super) fn format(self) -> &'static Format {
                match self {
                    $(Self::$name => &$format,)*
                }
            }
        }
    };
}

formats! {
    /// 3D Gaussian Splatting; also reads SuperSplat's and PlayCanvas's `.compressed.ply`.
    Ply ".ply" ply::FORMAT;
    /// Niantic's SPZ.
    Spz ".spz" spz::FORMAT;
    /// PlayCanvas's SOG, in one file.
    Sog ".sog" sog::FORMAT;
    /// antimatter15's format of 32 bytes per Gaussian.
    Splat ".splat" splat::FORMAT;
    /// [`SceneFormat::Gltf`] in one binary file.
    Glb ".glb" gltf::BINARY;
    /// glTF 2.0 with KHR_gaussian_splatting.
    Gltf ".gltf" gltf::TEXT;
}

impl SceneFormat {
    /// Finds a format by extension, in any case, with or without its dot.
    pub fn named(extension: &str) -> Option<Self> {
        let extension = extension.strip_prefix('.').unwrap_or(extension);
        Self::ALL.iter().copied().find(|format| format.extension()[1..].eq_ignore_ascii_case(extension))
    }

    /// Finds a format by a path's extension.
    pub fn of_extension(path: impl AsRef<Path>) -> Option<Self> {
        Self::named(path.as_ref().extension()?.to_str()?)
    }

    /// Detects a format by a file's first bytes, else by extension.
    pub fn of_file(path: impl AsRef<Path>) -> Result<Option<Self>> {
        let path = path.as_ref();
        let (mut start, by_extension) = (Vec::new(), Self::of_extension(path));
        let longest = Self::ALL.iter().flat_map(|format| format.format().marks).map(|mark| mark.len()).max();
        let read = Source::open(path)?.take(longest.unwrap_or(0) as u64).read_to_end(&mut start);
        read.map_err(|source| Error::io(path, source))?;
        Ok(Self::detect(&start, by_extension))
    }

    /// A format without magic bytes in `otherwise` wins.
    fn detect(start: &[u8], otherwise: Option<Self>) -> Option<Self> {
        let marked = |format: &Self| format.format().marks.iter().any(|mark| start.starts_with(mark));
        otherwise
            .filter(|format| format.format().marks.is_empty())
            .or_else(|| Self::ALL.iter().copied().find(marked))
            .or(otherwise)
    }

    /// Returns true if the format stores spherical harmonics above degree 0.
    pub fn keeps_view_dependence(self) -> bool {
        self.format().view_dependence
    }

    /// Returns true if the format stores [`Scene::antialiased`].
    pub fn keeps_antialiased(self) -> bool {
        self.format().antialiased
    }

    /// Returns the Gaussians in a file's order, if the format has one.
    pub fn order(self, scene: &Scene) -> Option<Vec<usize>> {
        self.format().order.map(|order| order(scene))
    }

    /// Returns true if the format can store the scene's world: all but `.splat` and SPZ version 4.
    pub fn keeps_world(self, options: &SaveOptions) -> bool {
        self.format().world.is_some() && !(self == Self::Spz && options.spz_version == 4)
    }
}

impl Scene {
    /// Reads a scene, detected as [`SceneFormat::of_file`], and converts it to axes x right, y
    /// down, z forward.
    ///
    /// # Errors
    /// [`Error::Format`] for unknown or damaged files, and non-finite or out-of-range values.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        Self::open_unchecked(path.as_ref())?.validated(path.as_ref())
    }

    /// Reads as [`Scene::open`], without validating values: NaN passes.
    pub fn open_unchecked(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let format = SceneFormat::of_file(path)?.ok_or_else(|| no_scene(path))?;
        (format.format().read)(Source::open(path)?)
    }

    /// Decodes a scene as [`Scene::open`], detected by its first bytes, else of `format`, which
    /// `.splat`, `.sog` and `.gltf` need. A glTF may not refer to other files.
    pub fn decode(bytes: &[u8], format: Option<SceneFormat>) -> Result<Self> {
        Self::decode_unchecked(bytes, format)?.validated(Path::new(IN_MEMORY))
    }

    /// Decodes as [`Scene::decode`], without validating values.
    pub fn decode_unchecked(bytes: &[u8], format: Option<SceneFormat>) -> Result<Self> {
        let name = Path::new(IN_MEMORY);
        let format = SceneFormat::detect(bytes, format).ok_or_else(|| no_scene(name))?;
        (format.format().read)(Source::memory(name, bytes))
    }

    /// Writes a scene atomically, in the format of the extension. No format stores cameras; see
    /// [`write_transforms`](super::poses::write_transforms).
    ///
    /// # Errors
    /// [`Error::Argument`] for an unknown extension or a scene that the format cannot store.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        self.save_with(path, &SaveOptions::default())
    }

    /// Writes as [`Scene::save`], with options.
    pub fn save_with(&self, path: impl AsRef<Path>, options: &SaveOptions) -> Result<()> {
        self.save_in(path, options, None)
    }

    /// As [`Scene::save_with`], with a world for [`read_world`](super::read_world) if
    /// [`SceneFormat::keeps_world`].
    pub fn save_in(&self, path: impl AsRef<Path>, options: &SaveOptions, world: Option<&World>) -> Result<()> {
        let path = path.as_ref();
        let format = SceneFormat::of_extension(path)
            .ok_or_else(|| Error::argument("scene file", path.display(), SceneFormat::EXTENSIONS))?;
        self.validate()?;
        write_atomic(path, (format.format().write)(&self.in_order_of(format), options, world)?)
    }

    /// Encodes the file of [`Scene::save_in`].
    pub fn encode(&self, format: SceneFormat, options: &SaveOptions, world: Option<&World>) -> Result<Vec<u8>> {
        self.validate()?;
        let (mut bytes, name) = (Vec::new(), Path::new(IN_MEMORY));
        let written = (format.format().write)(&self.in_order_of(format), options, world)?(&mut bytes);
        written.map_err(|source| Error::io(name, source))?;
        Ok(bytes)
    }

    fn in_order_of(&self, format: SceneFormat) -> Cow<'_, Self> {
        let Some(order) = format.order(self) else { return Cow::Borrowed(self) };
        let mut ordered = self.clone();
        ordered.keep(&order);
        Cow::Owned(ordered)
    }
}

const IN_MEMORY: &str = "scene in memory";

fn no_scene(name: &Path) -> Error {
    Error::format(name, Some(0), format!("no scene, expected {}", SceneFormat::EXTENSIONS))
}

/// Reads a scene's world, if this engine stored one.
pub fn read_world(path: impl AsRef<Path>) -> Result<Option<World>> {
    let path = path.as_ref();
    world(SceneFormat::of_file(path)?, || Source::open(path))
}

/// Reads the world of [`Scene::decode`]'s bytes.
pub fn decode_world(bytes: &[u8], format: Option<SceneFormat>) -> Result<Option<World>> {
    world(SceneFormat::detect(bytes, format), || Ok(Source::memory(Path::new(IN_MEMORY), bytes)))
}

fn world<'a>(format: Option<SceneFormat>, open: impl FnOnce() -> Result<Source<'a>>) -> Result<Option<World>> {
    let Some(read) = format.and_then(|format| format.format().world) else { return Ok(None) };
    Ok(read(open()?)?.as_deref().and_then(World::parse))
}
