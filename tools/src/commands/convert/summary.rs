use crate::{
    options::SceneInput,
    outputs::size_of,
    session::Session,
    table::{Table, bytes, counted},
};
use indicatif::HumanCount;
use serde_json::{Value, json};
use std::path::Path;
use zipsplat::{
    Result,
    types::{Origin, read_world},
    weights::{Checkpoint, DepthCheckpoint},
};

pub fn checkpoint(session: &mut Session<'_>, checkpoint: &Checkpoint) -> Result<()> {
    checkpoint.notes().iter().for_each(|note| session.note(note));
    let (architecture, tensors) = (checkpoint.architecture(), checkpoint.parameters().len());
    let json = json!({
        "source": checkpoint.provenance(), "architecture": architecture, "tensors": tensors,
        "parameters": architecture.parameter_count(), "bytes": checkpoint.bytes(), "stored": checkpoint.stored(),
    });
    weights(session, &json, checkpoint.provenance(), &architecture.name)
}

pub fn depth_checkpoint(session: &mut Session<'_>, checkpoint: &DepthCheckpoint) -> Result<()> {
    let (architecture, tensors) = (checkpoint.architecture(), checkpoint.parameters().len());
    let kind = if architecture.camera_head.is_some() { "VGGT" } else { "Depth Anything 3" };
    let json = json!({
        "source": checkpoint.provenance(), "kind": kind, "architecture": architecture, "tensors": tensors,
        "estimates_cameras": architecture.multi_view(), "sky": !architecture.multi_view(), "gaussians": architecture.gaussians,
        "parameters": architecture.parameter_count(), "bytes": checkpoint.bytes(), "stored": checkpoint.stored(),
    });
    let what = if architecture.multi_view() {
        "depth and cameras of photos seen at once"
    } else {
        "depth and sky of each photo by itself, no cameras"
    };
    let more = if architecture.gaussians { ", a Gaussian a pixel" } else { "" };
    let name = format!("{} of {kind}: {what}{more}", architecture.name);
    weights(session, &json, checkpoint.provenance(), &name)
}

fn weights(session: &mut Session<'_>, json: &Value, source: &str, name: &str) -> Result<()> {
    let number = |value: &Value| value.as_u64().unwrap_or_default();
    let stored = json["stored"].as_object().into_iter().flatten();
    let stored: Vec<String> = stored.map(|(kind, size)| format!("{kind} {}", bytes(number(size)))).collect();
    let mut text = format!(
        "{source}: {name}, {} parameters in {} tensors, {} ({})\n",
        HumanCount(number(&json["parameters"])),
        json["tensors"],
        bytes(number(&json["bytes"])),
        stored.join(", ")
    );
    let mut table = Table::new(2, &["architecture", ""]);
    if let serde_json::Value::Object(fields) = &json["architecture"] {
        for (field, value) in fields {
            table.row([field.clone(), value.to_string()]);
        }
    }
    text += &table.to_string();
    session.report(json, text)
}

pub fn scene(session: &mut Session<'_>, path: &str, input: &SceneInput) -> Result<()> {
    let file = Path::new(path);
    let (scene, dropped) = input.read(session, file)?;
    let size = size_of(file)?;
    let (count, degree) = (scene.len(), scene.sh_degree);
    let world = read_world(file)?.map(|world| match world.origin {
        Origin::Photo(photo) => format!("the camera of {photo}"),
        Origin::Cameras(_) => "that of its cameras".into(),
    });
    let bounds = ranges(scene.means.iter().copied());
    let [scales] = ranges(scene.scales.as_flattened().iter().map(|scale| [*scale]));
    let [opacities] = ranges(scene.opacities.iter().map(|opacity| [*opacity]));
    let corners = || Some([0, 1].map(|end| bounds.map(|range| range.map_or(f32::NAN, |range| range[end]))));
    let json = json!({
        "path": path, "gaussians": count, "dropped": dropped, "sh_degree": degree, "antialiased": scene.antialiased,
        "bounds": bounds[0].and_then(|_| corners()), "scales": scales, "opacities": opacities, "world": world, "bytes": size,
    });
    let kind = if scene.antialiased { ", antialiased" } else { "" };
    let (gaussians, size_text) = (counted(count, "Gaussian"), bytes(size));
    let mut text = format!("{path}: {gaussians}, spherical harmonics of degree {degree}{kind}, {size_text}\n");
    let mut table = Table::new(1, &["", "least", "greatest"]);
    let [x, y, z] = bounds;
    for (name, range) in [("x", x), ("y", y), ("z", z), ("scale", scales), ("opacity", opacities)] {
        if let Some([least, greatest]) = range {
            table.row([name.into(), format!("{least:.6}"), format!("{greatest:.6}")]);
        }
    }
    text += &table.to_string();
    if let Some(world) = world {
        text += &format!("world: {world}");
    }
    session.report(&json, text)
}

fn ranges<const N: usize>(rows: impl Iterator<Item = [f32; N]>) -> [Option<[f32; 2]>; N] {
    rows.fold([None; N], |ranges: [Option<[f32; 2]>; N], row| {
        std::array::from_fn(|i| {
            let [least, greatest] = ranges[i].unwrap_or([row[i]; 2]);
            Some([least.min(row[i]), greatest.max(row[i])])
        })
    })
}
