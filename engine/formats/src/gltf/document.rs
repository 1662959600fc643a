//! glTF JSON for Gaussians, and the binary container.

use std::collections::{HashMap, HashSet};

use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

use super::{EXTENSION, Fault, Parsed};
use crate::world::MADE_BY;

/// KHR_mesh_quantization only permits small integers for floats.
const KNOWN: [&str; 2] = [EXTENSION, "KHR_mesh_quantization"];
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BIN_CHUNK: u32 = 0x004e_4942;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Document {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
    scene: Option<usize>,
    #[serde(default)]
    scenes: Vec<SceneNodes>,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    meshes: Vec<Mesh>,
    #[serde(default)]
    pub accessors: Vec<Accessor>,
    #[serde(default)]
    pub buffer_views: Vec<BufferView>,
    #[serde(default)]
    pub buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Asset {
    version: String,
    #[serde(default)]
    extras: serde_json::Value,
}

#[derive(Deserialize)]
struct SceneNodes {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    /// Column-major; replaces the three fields below.
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    /// xyzw.
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
pub(super) struct Primitive {
    pub attributes: HashMap<String, usize>,
    #[serde(default)]
    extensions: HashMap<String, serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Accessor {
    pub buffer_view: Option<usize>,
    #[serde(default)]
    pub byte_offset: usize,
    pub component_type: u32,
    #[serde(default)]
    pub normalized: bool,
    pub count: usize,
    #[serde(rename = "type")]
    pub shape: String,
    pub sparse: Option<serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct BufferView {
    pub buffer: usize,
    #[serde(default)]
    pub byte_offset: usize,
    pub byte_length: usize,
    pub byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Buffer {
    pub uri: Option<String>,
    pub byte_length: usize,
}

pub(super) fn unpack(bytes: &[u8]) -> Parsed<(&[u8], Option<&[u8]>)> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes, None));
    }
    let word = |at: usize| {
        let word = bytes.get(at..).and_then(|rest| rest.first_chunk::<4>());
        word.map(|word| u32::from_le_bytes(*word)).ok_or_else(|| Fault::at(at, "truncated".into()))
    };
    if word(4)? != 2 {
        return Err(Fault::at(4, format!("found version {}, expected 2", word(4)?)));
    }
    if word(8)? as usize > bytes.len() {
        return Err(Fault::at(8, format!("truncated: found {} bytes, expected {}", bytes.len(), word(8)?)));
    }
    let chunk = |at: usize, kind: u32| {
        let (length, found) = (word(at)? as usize, word(at + 4)?);
        if found != kind {
            return Err(Fault::at(at + 4, format!("found a chunk of type {found:#010x}, expected {kind:#010x}")));
        }
        let body = bytes[at + 8..].get(..length);
        body.ok_or_else(|| {
            Fault::at(at, format!("truncated: the chunk has {length} bytes, {} follow", bytes.len() - at - 8))
        })
    };
    let json = chunk(12, JSON_CHUNK)?;
    let next = 20 + json.len();
    let binary = if next < bytes.len() { Some(chunk(next, BIN_CHUNK)?) } else { None };
    Ok((json, binary))
}

impl Document {
    pub(super) fn parse(json: &[u8]) -> Parsed<Self> {
        let document: Self = serde_json::from_slice(json).map_err(|error| format!("JSON: {error}"))?;
        if !document.asset.version.starts_with("2.") {
            return Err(format!("found glTF version {:?}, expected 2.0", document.asset.version).into());
        }
        match document.extensions_required.iter().find(|name| !KNOWN.contains(&name.as_str())) {
            Some(name) => Err(format!("requires the extension {name}, known are {}", KNOWN.join(" and ")).into()),
            None => Ok(document),
        }
    }

    pub(super) fn line(&self) -> Option<&str> {
        self.asset.extras.get(MADE_BY)?.as_str()
    }

    /// Nodes may share meshes, so visits can far outnumber bytes.
    pub(super) fn visit(&self, mut visit: impl FnMut(&Primitive, &DMat4) -> Parsed<()>) -> Parsed<()> {
        let mut seen = vec![false; self.nodes.len()];
        let mut waiting: Vec<_> = self.roots()?.into_iter().rev().map(|node| (node, DMat4::IDENTITY)).collect();
        while let Some((index, parent)) = waiting.pop() {
            let node =
                self.nodes.get(index).ok_or_else(|| format!("no node {index}, there are {}", self.nodes.len()))?;
            if std::mem::replace(&mut seen[index], true) {
                return Err(format!("node {index} is reached twice, expected a tree").into());
            }
            let to_world = parent * node.matrix();
            waiting.extend(node.children.iter().rev().map(|&child| (child, to_world)));
            let Some(mesh) = node.mesh else { continue };
            let mesh =
                self.meshes.get(mesh).ok_or_else(|| format!("no mesh {mesh}, there are {}", self.meshes.len()))?;
            for primitive in &mesh.primitives {
                if primitive.has_gaussians()? {
                    visit(primitive, &to_world)?;
                }
            }
        }
        Ok(())
    }

    /// Returns the roots of the default or first scene; without scenes, all nodes without parents.
    fn roots(&self) -> Parsed<Vec<usize>> {
        if self.scenes.is_empty() {
            let children: HashSet<usize> = self.nodes.iter().flat_map(|node| node.children.iter().copied()).collect();
            return Ok((0..self.nodes.len()).filter(|index| !children.contains(index)).collect());
        }
        let index = self.scene.unwrap_or(0);
        let scene =
            self.scenes.get(index).ok_or_else(|| format!("no scene {index}, there are {}", self.scenes.len()))?;
        Ok(scene.nodes.clone())
    }
}

impl Node {
    fn matrix(&self) -> DMat4 {
        if let Some(columns) = &self.matrix {
            return DMat4::from_cols_array(columns);
        }
        let rotation = self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array);
        let (scale, translation) = (self.scale.unwrap_or([1.0; 3]), self.translation.unwrap_or([0.0; 3]));
        DMat4::from_scale_rotation_translation(DVec3::from(scale), rotation, DVec3::from(translation))
    }
}

impl Primitive {
    fn has_gaussians(&self) -> Parsed<bool> {
        let Some(extension) = self.extensions.get(EXTENSION) else { return Ok(false) };
        for (property, expected) in [("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")] {
            let found = extension.get(property).and_then(|value| value.as_str()).unwrap_or(expected);
            if found != expected {
                return Err(format!("{EXTENSION}: found {property} {found:?}, expected {expected:?}").into());
            }
        }
        Ok(true)
    }
}
