//! Scene files of every format that is known.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::{Scene, World, gltf, ply, splat, spz};
use crate::{Error, Result};

/// What a scene file is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneFormat {
    /// 3D Gaussian Splatting PLY.
    Ply,
    /// Niantic's SPZ.
    Spz,
    /// antimatter15's 32 bytes a Gaussian.
    Splat,
    /// glTF 2.0 with KHR_gaussian_splatting, as JSON.
    Gltf,
    /// The same in one binary file.
    Glb,
}

/// How a scene is written where its format leaves a choice.
#[derive(Clone, Copy, Debug)]
pub struct WriteOptions {
    /// Version of an SPZ: 3, or 2 for older readers.
    pub spz_version: u32,
}

impl Default for WriteOptions {
    fn default() -> Self {
        Self { spz_version: 3 }
    }
}

impl SceneFormat {
    /// Extensions of the formats, for messages.
    pub const EXTENSIONS: &str = ".ply, .spz, .splat, .glb or .gltf";

    /// By the path's extension, in any case.
    pub fn of_extension(path: impl AsRef<Path>) -> Option<Self> {
        match path.as_ref().extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "ply" => Some(Self::Ply),
            "spz" => Some(Self::Spz),
            "splat" => Some(Self::Splat),
            "gltf" => Some(Self::Gltf),
            "glb" => Some(Self::Glb),
            _ => None,
        }
    }

    /// By a file's first bytes, else by its extension; none where neither is a scene's. A `.splat` and a `.gltf` have
    /// no mark and go by their extension alone.
    ///
    /// # Errors
    /// [`Error::Io`] when the file cannot be read.
    pub fn of_file(path: impl AsRef<Path>) -> Result<Option<Self>> {
        let path = path.as_ref();
        let by_extension = Self::of_extension(path);
        let mut start = Vec::new();
        let read = File::open(path).and_then(|file| file.take(4).read_to_end(&mut start));
        read.map_err(|source| Error::io(path, source))?;
        Ok(match (by_extension, &start[..]) {
            (Some(Self::Splat | Self::Gltf), _) => by_extension,
            (_, [b'p', b'l', b'y', ..]) => Some(Self::Ply),
            (_, [0x1f, 0x8b, ..] | b"NGSP") => Some(Self::Spz),
            (_, b"glTF") => Some(Self::Glb),
            _ => by_extension,
        })
    }

    /// Whether it keeps spherical harmonics above degree 0.
    pub fn keeps_view_dependence(self) -> bool {
        self != Self::Splat
    }

    /// Whether it has room for the world that a scene is in.
    pub fn keeps_world(self) -> bool {
        self != Self::Splat
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
    match SceneFormat::of_file(path)? {
        Some(SceneFormat::Ply) => ply::read_unchecked(path),
        Some(SceneFormat::Spz) => spz::read_unchecked(path),
        Some(SceneFormat::Splat) => splat::read_unchecked(path),
        Some(SceneFormat::Gltf | SceneFormat::Glb) => gltf::read_unchecked(path),
        None => Err(Error::format(path, Some(0), format!("no scene, expected {}", SceneFormat::EXTENSIONS))),
    }
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
    match SceneFormat::of_extension(path) {
        Some(SceneFormat::Ply) => ply::write(scene, path, world),
        Some(SceneFormat::Spz) => spz::write(scene, path, options.spz_version, world),
        Some(SceneFormat::Splat) => splat::write_splat(scene, path),
        Some(SceneFormat::Gltf) => gltf::write(scene, path, false, world),
        Some(SceneFormat::Glb) => gltf::write(scene, path, true, world),
        None => Err(Error::argument("scene file", path.display(), SceneFormat::EXTENSIONS)),
    }
}
