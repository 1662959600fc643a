mod plan;

use self::plan::Refinement;
use crate::{
    options::{Quality, SceneInput, Size, Weights, refuse},
    refinement::Moved,
    released::{is_of_depth, open_depth},
    session::Session,
    table::{Table, bytes, counted},
};
use clap::{Arg, ArgGroup, Args};
use indicatif::HumanCount;
use serde_json::{Value, json};
use std::{fmt::Write, path::Path};
use zipsplat::{
    Error, Result,
    gpu::{Limits, Matrices, MatrixShape, list_devices},
    ops::{Arithmetic, Precision},
    types::{Origin, SceneFormat, read_world},
    weights::{Checkpoint, DepthCheckpoint},
};

/// Devices, contents of a checkpoint or scene, or memory of a reconstruction
#[derive(Args)]
#[command(
    mut_args(for_plans),
    group(ArgGroup::new("moved").args(["optimize_cameras", "max_gaussians", "lpips_weight"]).multiple(true).requires("refine")),
    after_help = "Examples:
  zipsplat info                                                every Vulkan device and whether it can be used
  zipsplat info zipsplat.safetensors
  zipsplat info scene.ply
  zipsplat info --plan --weights seeded:vitg --views 24 --ratio auto
  zipsplat info --plan --weights seeded:vitg --views 24 --refine 252x252 --lpips-weight 0.05
  zipsplat info --plan --weights seeded:da3-base --views 24 --input-size 504x336"
)]
pub struct Info {
    /// Checkpoint of ZipSplat or Depth Anything 3, seeded:VARIANT[:KEY], or scene (PLY, SPZ, .splat
    /// or glTF)
    file: Option<String>,
    #[command(flatten)]
    scene_input: SceneInput,
    /// Print the memory plan of a reconstruction; without a device, for an ordinary one
    #[arg(long, requires = "views", conflicts_with = "file")]
    plan: bool,
    #[command(flatten)]
    weights: Weights,
    /// Photos of the plan
    #[arg(long, value_name = "N", requires = "plan")]
    views: Option<usize>,
    #[command(flatten)]
    quality: Quality,
    /// Plan for known cameras
    #[arg(long, requires = "plan")]
    cameras: bool,
    /// Also plan pictures of this size, two in flight as in zipsplat render
    #[arg(long, value_name = "WxH", requires = "plan")]
    pictures: Option<Size>,
    /// Also plan a refinement against as many photos of this size; with :tokens of the network's
    /// tokens instead of the Gaussians
    #[arg(long, value_name = "WxH[:tokens|gaussians]", requires = "plan")]
    refine: Option<Refinement>,
    #[command(flatten)]
    moved: Moved,
    /// Print every tensor of the plan, by first use, not only the largest
    #[arg(long, requires = "plan")]
    all: bool,
}

fn for_plans(arg: Arg) -> Arg {
    match arg.get_id().as_str() {
        "weights"
        | "ratio"
        | "token_selection"
        | "kv_pool"
        | "max_gaussians_per_token"
        | "input_size"
        | "precision" => arg.requires("plan"),
        "drop_invalid" => arg.requires("file"),
        _ => arg,
    }
}

impl Info {
    pub fn plans(&self) -> bool {
        self.plan
    }

    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        match (&self.file, self.views) {
            (Some(file), _) if is_scene(Path::new(file))? => scene(session, file, &self.scene_input),
            (Some(file), _) => {
                refuse("--drop-invalid", self.scene_input.is_given(), "a checkpoint", "a scene")?;
                if is_of_depth(file) {
                    depth_checkpoint(session, &open_depth(file, true)?)
                } else {
                    checkpoint(session, &self.weights.open_unless_scene(file)?)
                }
            }
            (None, Some(views)) => plan::show(session, self, views),
            (None, None) => devices(session),
        }
    }
}

/// [`Checkpoint::open`] reports unreadable paths.
fn is_scene(path: &Path) -> Result<bool> {
    if path.is_dir() {
        return Err(Error::argument("file", format!("the folder {}", path.display()), "a checkpoint or scene"));
    }
    Ok(matches!(SceneFormat::of_file(path), Ok(Some(_))))
}

fn devices(session: &mut Session<'_>) -> Result<()> {
    let devices = list_devices()?;
    let mut text = String::new();
    for device in &devices {
        let limits = &device.limits;
        let kind = match (limits.cpu, limits.discrete) {
            (true, _) => "CPU",
            (_, true) => "discrete GPU",
            _ => "integrated or virtual GPU",
        };
        let usable = match &device.unusable_reason[..] {
            [] => "usable".to_owned(),
            missing => format!("NOT usable: lacks {}", missing.join(", ")),
        };
        let [x, y, z] = limits.max_groups;
        let rows = [
            ("driver", limits.driver.clone()),
            ("Vulkan", limits.api.clone()),
            ("kind", kind.to_owned()),
            ("memory", bytes(limits.memory_bytes)),
            ("block", format!("{} in one allocation", bytes(limits.max_block_bytes))),
            ("binding", format!("{} seen by a kernel at once", bytes(limits.max_binding_bytes))),
            ("shared", bytes(limits.shared_bytes.into())),
            ("subgroup", format!("{} invocations", limits.subgroup_size)),
            ("16 bits", if limits.half_storage { "floats in buffers" } else { "none" }.to_owned()),
            ("matrices", matrices(limits)),
            ("int8", int8(limits).to_owned()),
            ("workgroups", format!("{x} x {y} x {z}")),
            (
                "timestamps",
                if limits.timestamp_bits > 0 { format!("{} ns", limits.timestamp_ns) } else { "none".into() },
            ),
        ];
        let _ = writeln!(text, "{}: {}, {usable}", device.index, limits.name);
        for (name, value) in rows {
            let _ = writeln!(text, "   {name:<11}{value}");
        }
    }
    session.report(&devices, text)
}

fn matrices(limits: &Limits) -> String {
    let sides = |shape: MatrixShape| format!("{} x {} x {}", shape.m, shape.n, shape.k);
    let Matrices { f16, bf16, i8 } = limits.matrices;
    let of_subgroups = [("f16", f16), ("bf16", bf16), ("i8", i8)]
        .into_iter()
        .filter_map(|(factor, shape)| Some(format!("{factor} {}", sides(shape?))));
    let all: Vec<_> = of_subgroups.collect();
    if all.is_empty() { "none".into() } else { all.join(", ") }
}

fn int8(limits: &Limits) -> &'static str {
    match Arithmetic::of(Precision::Int8, limits) {
        Some(Arithmetic { quantized: Some(_), .. }) => "8-bit integers on matrix units",
        Some(_) if limits.dot_products_accelerated => "8-bit integers by dot products, which the device accelerates",
        Some(_) => "8-bit integers by dot products, which the device does not accelerate: less memory, not less time",
        None => "not on this device",
    }
}

fn checkpoint(session: &mut Session<'_>, checkpoint: &Checkpoint) -> Result<()> {
    checkpoint.notes().iter().for_each(|note| session.note(note));
    let (architecture, tensors) = (checkpoint.architecture(), checkpoint.parameters().len());
    let json = json!({
        "source": checkpoint.provenance(), "architecture": architecture, "tensors": tensors,
        "parameters": architecture.parameter_count(), "bytes": checkpoint.bytes(), "stored": checkpoint.stored(),
    });
    weights(session, &json, checkpoint.provenance(), &architecture.name)
}

fn depth_checkpoint(session: &mut Session<'_>, checkpoint: &DepthCheckpoint) -> Result<()> {
    let (architecture, tensors) = (checkpoint.architecture(), checkpoint.parameters().len());
    let json = json!({
        "source": checkpoint.provenance(), "kind": "Depth Anything 3", "architecture": architecture, "tensors": tensors,
        "cameras": architecture.multi_view(), "sky": !architecture.multi_view(), "gaussians": architecture.gaussians,
        "parameters": architecture.parameter_count(), "bytes": checkpoint.bytes(), "stored": checkpoint.stored(),
    });
    let what = if architecture.multi_view() {
        "depth, rays and cameras of photos seen at once"
    } else {
        "depth and sky of each photo by itself, no cameras"
    };
    let more = if architecture.gaussians { ", a Gaussian a pixel" } else { "" };
    let name = format!("{} of Depth Anything 3: {what}{more}", architecture.name);
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

fn scene(session: &mut Session<'_>, path: &str, input: &SceneInput) -> Result<()> {
    let file = Path::new(path);
    let (scene, dropped) = input.read(session, file)?;
    let size = file.metadata().map_err(|error| Error::io(file, error))?.len();
    let (count, degree) = (scene.len(), scene.sh_degree);
    let world = read_world(file)?.map(|world| match world.origin {
        Origin::Photo(photo) => format!("the camera of {photo}"),
        Origin::Cameras(_) => "that of its cameras".into(),
    });
    let bounds = ranges(scene.means.iter().copied());
    let [scales] = ranges(scene.scales.as_flattened().iter().map(|scale| [*scale]));
    let [opacities] = ranges(scene.opacities.iter().map(|opacity| [*opacity]));
    // Minimum and maximum.
    let corners = || Some([0, 1].map(|end| bounds.map(|range| range.map_or(f32::NAN, |range| range[end]))));
    let json = json!({
        "path": path, "gaussians": count, "dropped": dropped, "sh_degree": degree, "bounds": bounds[0].and_then(|_| corners()),
        "scales": scales, "opacities": opacities, "world": world, "bytes": size,
    });
    let mut text =
        format!("{path}: {}, spherical harmonics of degree {degree}, {}\n", counted(count, "Gaussian"), bytes(size));
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
