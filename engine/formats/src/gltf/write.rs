use base64::{Engine, engine::general_purpose::STANDARD};
use serde_json::{Value, json};

use super::EXTENSION;
use crate::format::{Encoder, SaveOptions};
use crate::{Error, Result};
use crate::{Scene, World, axes::HalfTurn::AboutZ, camera::unit_quaternion, world::MADE_BY};

const FLOAT: u32 = 5126;
const ARRAY_BUFFER: u32 = 34962;

#[derive(Default)]
struct Attributes {
    data: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    by_name: serde_json::Map<String, Value>,
}

impl Attributes {
    fn add<const N: usize>(&mut self, name: &str, values: impl Iterator<Item = [f32; N]>) {
        let start = self.data.len();
        values.flatten().for_each(|value| self.data.extend_from_slice(&value.to_le_bytes()));
        let length = self.data.len() - start;
        self.by_name.insert(name.into(), self.accessors.len().into());
        let (shape, count) = (["SCALAR", "VEC2", "VEC3", "VEC4"][N - 1], length / (4 * N));
        let view = self.views.len();
        self.accessors.push(json!({ "bufferView": view, "componentType": FLOAT, "count": count, "type": shape }));
        self.views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": length, "target": ARRAY_BUFFER }));
    }
}

pub(super) fn binary<'a>(scene: &'a Scene, _: &SaveOptions, world: Option<&World>) -> Result<Encoder<'a>> {
    encoder(scene, true, world)
}

pub(super) fn text<'a>(scene: &'a Scene, _: &SaveOptions, world: Option<&World>) -> Result<Encoder<'a>> {
    encoder(scene, false, world)
}

fn encoder<'a>(scene: &'a Scene, binary: bool, world: Option<&World>) -> Result<Encoder<'a>> {
    if scene.is_empty() {
        return Err(Error::argument("scene", "no Gaussians", "at least one in a glTF"));
    }
    let Attributes { data, views, accessors, by_name } = attributes(scene);
    let mut buffer = json!({ "byteLength": data.len() });
    if !binary {
        buffer["uri"] = format!("data:application/octet-stream;base64,{}", STANDARD.encode(&data)).into();
    }
    let extension = json!({
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    });
    let extras = json!({ MADE_BY: World::line(world) });
    let document = json!({
        "asset": { "version": "2.0", "generator": concat!("zipsplat ", env!("CARGO_PKG_VERSION")), "extras": extras },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "mode": 0, "attributes": by_name, "extensions": { EXTENSION: extension } }] }],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [buffer],
    });
    let mut json = document.to_string().into_bytes();
    if !binary {
        return Ok(Box::new(move |out| out.write_all(&json)));
    }
    json.resize(json.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + json.len() + 8 + data.len();
    let length = u32::try_from(total)
        .map_err(|_| Error::argument("scene", format!("{total} bytes"), "fewer than 2^32, the most of a .glb"))?;
    Ok(Box::new(move |out| {
        out.write_all(b"glTF")?;
        out.write_all(&2u32.to_le_bytes())?;
        out.write_all(&length.to_le_bytes())?;
        for (kind, chunk) in [(b"JSON", &json), (b"BIN\0", &data)] {
            out.write_all(&(chunk.len() as u32).to_le_bytes())?;
            out.write_all(kind)?;
            out.write_all(chunk)?;
        }
        Ok(())
    }))
}

fn attributes(scene: &Scene) -> Attributes {
    let own = |name: &str| format!("{EXTENSION}:{name}");
    let mut attributes = Attributes::default();
    let points = || scene.means.iter().map(|&mean| AboutZ.point(mean));
    attributes.add("POSITION", points());
    for (key, pick) in [("min", f32::min as fn(f32, f32) -> f32), ("max", f32::max)] {
        let bound = points().reduce(|a, b| std::array::from_fn(|axis| pick(a[axis], b[axis])));
        attributes.accessors[0][key] = json!(bound);
    }
    let unit = |quat: &[f32; 4]| {
        let [w, x, y, z] = unit_quaternion(AboutZ.quat(*quat));
        [x, y, z, w]
    };
    attributes.add(&own("ROTATION"), scene.quats.iter().map(unit));
    attributes.add(&own("SCALE"), scene.scales.iter().copied());
    attributes.add(&own("OPACITY"), scene.opacities.iter().map(|&opacity| [opacity]));
    let k = scene.sh_coeffs_per_gaussian();
    for i in 0..k {
        let degree = i.isqrt();
        let values = scene.sh_coeffs.iter().skip(i).step_by(k).map(|rgb| rgb.map(|value| AboutZ.sh(i) * value));
        attributes.add(&own(&format!("SH_DEGREE_{degree}_COEF_{}", i - degree * degree)), values);
    }
    attributes
}
