//! Scene files of every format that is known. A format is a module beside this file and a line of the table below.

use std::io::Read;
use std::path::Path;

use super::{
    Scene, World,
    format::{Format, WriteOptions},
    gltf, ply,
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

/// The enumeration of formats from their table: name, extension, and what their module says.
macro_rules! formats {
    ($($(#[$doc:meta])* $name:ident $extension:literal $format:path;)*) => {
        /// What a scene file is.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum SceneFormat {
            $($(#[$doc])* $name,)*
        }

        impl SceneFormat {
            /// Every format, in the order of messages.
            pub const ALL: &[Self] = &[$(Self::$name),*];

            /// Extensions of the formats, for messages.
            pub const EXTENSIONS: &str = listed!($($extension),*);

            /// How the names of its files end, such as ".ply".
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
    /// 3D Gaussian Splatting PLY; read are also the packed ones of SuperSplat and PlayCanvas (`.compressed.ply`).
    Ply ".ply" ply::FORMAT;
    /// Niantic's SPZ.
    Spz ".spz" spz::FORMAT;
    /// antimatter15's 32 bytes a Gaussian.
    Splat ".splat" splat::FORMAT;
    /// The same as [`SceneFormat::Gltf`] in one binary file.
    Glb ".glb" gltf::BINARY;
    /// glTF 2.0 with KHR_gaussian_splatting, as JSON.
    Gltf ".gltf" gltf::TEXT;
}

impl SceneFormat {
    /// By an extension, in any case and with its dot or without.
    pub fn named(extension: &str) -> Option<Self> {
        let extension = extension.strip_prefix('.').unwrap_or(extension);
        Self::ALL.iter().copied().find(|format| format.extension()[1..].eq_ignore_ascii_case(extension))
    }

    /// By the path's extension, in any case.
    pub fn of_extension(path: impl AsRef<Path>) -> Option<Self> {
        Self::named(path.as_ref().extension()?.to_str()?)
    }

    /// By a file's first bytes, else by its extension; none where neither is a scene's. A `.splat` and a `.gltf` have
    /// no mark and go by their extension alone.
    ///
    /// # Errors
    /// [`Error::Io`] when the file cannot be read.
    pub fn of_file(path: impl AsRef<Path>) -> Result<Option<Self>> {
        let path = path.as_ref();
        let (mut start, by_extension) = (Vec::new(), Self::of_extension(path));
        let longest = Self::ALL.iter().flat_map(|format| format.format().marks).map(|mark| mark.len()).max();
        let read = Source::open(path)?.take(longest.unwrap_or(0) as u64).read_to_end(&mut start);
        read.map_err(|source| Error::io(path, source))?;
        Ok(Self::told(&start, by_extension))
    }

    /// By a file's first bytes, else `otherwise`, which counts first where it has no mark.
    fn told(start: &[u8], otherwise: Option<Self>) -> Option<Self> {
        let marked = |format: &Self| format.format().marks.iter().any(|mark| start.starts_with(mark));
        otherwise
            .filter(|format| format.format().marks.is_empty())
            .or_else(|| Self::ALL.iter().copied().find(marked))
            .or(otherwise)
    }

    /// Whether it keeps spherical harmonics above degree 0.
    pub fn keeps_view_dependence(self) -> bool {
        self.format().view_dependence
    }

    /// Whether it has room for the world that a scene is in: a `.splat` and an SPZ of version 4 have none.
    pub fn keeps_world(self, options: &WriteOptions) -> bool {
        self.format().world.is_some() && !(self == Self::Spz && options.spz_version == 4)
    }
}

/// Reads a scene of any format, told apart as [`SceneFormat::of_file`] does. Whatever axes the format has, the scene has
/// x right, y down, z forward.
///
/// # Errors
/// [`Error::Io`] when the file cannot be read; [`Error::Format`] when it is no scene or damaged, or holds values that are
/// not finite or not in their range.
pub fn read_scene(path: impl AsRef<Path>) -> Result<Scene> {
    read_scene_unchecked(path.as_ref())?.validated(path.as_ref())
}

/// As [`read_scene`], with the values as they are, NaN among them: for [`Scene::drop_invalid`], or [`Scene::validate`].
///
/// # Errors
/// As [`read_scene`], but for values.
pub fn read_scene_unchecked(path: impl AsRef<Path>) -> Result<Scene> {
    let path = path.as_ref();
    let format = SceneFormat::of_file(path)?.ok_or_else(|| no_scene(path))?;
    (format.format().read)(Source::open(path)?)
}

/// A scene from a file's bytes, told apart by the first of them, else of the format given: a `.splat` and a `.gltf` have no
/// mark and need it. A glTF may name no other file. Axes and values are those of [`read_scene`]; errors call the bytes
/// "scene in memory".
///
/// # Errors
/// [`Error::Format`] as [`read_scene`].
pub fn decode_scene(bytes: &[u8], format: Option<SceneFormat>) -> Result<Scene> {
    decode_scene_unchecked(bytes, format)?.validated(Path::new(IN_MEMORY))
}

/// As [`decode_scene`], with the values as they are, as [`read_scene_unchecked`] has them.
///
/// # Errors
/// As [`decode_scene`], but for values.
pub fn decode_scene_unchecked(bytes: &[u8], format: Option<SceneFormat>) -> Result<Scene> {
    let name = Path::new(IN_MEMORY);
    let format = SceneFormat::told(bytes, format).ok_or_else(|| no_scene(name))?;
    (format.format().read)(Source::memory(name, bytes))
}

/// What errors call bytes in memory.
const IN_MEMORY: &str = "scene in memory";

fn no_scene(name: &Path) -> Error {
    Error::format(name, Some(0), format!("no scene, expected {}", SceneFormat::EXTENSIONS))
}

/// Writes a scene in the format of the path's extension; the file appears whole or not at all. Cameras are not part of
/// any of the formats: [`write_transforms`](super::poses::write_transforms) keeps them beside the scene.
///
/// # Errors
/// [`Error::Argument`] when the extension is no scene's, the scene is not valid or the format cannot hold it;
/// [`Error::Io`] when the file cannot be written.
pub fn write_scene(path: impl AsRef<Path>, scene: &Scene, options: &WriteOptions) -> Result<()> {
    write_scene_in(path, scene, options, None)
}

/// As [`write_scene`], with the world that the scene is in, where that is known and [`SceneFormat::keeps_world`]: for
/// [`read_world`](super::read_world).
///
/// # Errors
/// As [`write_scene`].
pub fn write_scene_in(
    path: impl AsRef<Path>,
    scene: &Scene,
    options: &WriteOptions,
    world: Option<&World>,
) -> Result<()> {
    let path = path.as_ref();
    let format = SceneFormat::of_extension(path)
        .ok_or_else(|| Error::argument("scene file", path.display(), SceneFormat::EXTENSIONS))?;
    format.format().write_file(path, scene, options, world)
}

/// The bytes of the file that [`write_scene`] writes.
///
/// # Errors
/// [`Error::Argument`] when the scene is not valid or the format cannot hold it.
pub fn encode_scene(scene: &Scene, format: SceneFormat, options: &WriteOptions) -> Result<Vec<u8>> {
    scene.validate()?;
    let (mut bytes, name) = (Vec::new(), Path::new(IN_MEMORY));
    let written = (format.format().write)(scene, options, None)?(&mut bytes);
    written.map_err(|source| Error::io(name, source))?;
    Ok(bytes)
}

/// The world of a scene, where its file says so: a PLY, an SPZ or a glTF that this engine wrote of a scene whose world was
/// known. A `.splat` has no room for it.
///
/// # Errors
/// [`Error::Io`] when the file cannot be read.
pub fn read_world(path: impl AsRef<Path>) -> Result<Option<World>> {
    let path = path.as_ref();
    let Some(read) = SceneFormat::of_file(path)?.and_then(|format| format.format().world) else { return Ok(None) };
    Ok(read(path)?.as_deref().and_then(World::parse))
}
