use crate::{
    cameras::{WorldPhoto, to_scene},
    lifted,
    options::SceneInput,
    outputs::{self, Overwrite, size_of},
    session::Session,
    table::{Table, bytes, counted},
};
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches, error::ErrorKind};
use indicatif::HumanCount;
use serde_json::json;
use std::path::PathBuf;
use zipsplat::{
    Camera, Edit as Operation, Edited, Error, Result, SaveOptions, Scene,
    features::Lifted,
    types::{SceneFormat, World, poses::Capture, read_world},
};

/// Clean, crop, move, merge and shrink scenes
///
/// Merges the scenes, then applies the edits in the order given. Lengths and positions are in the
/// scene's world: x right, y down, z forward in the first photo, or the cameras' world. A moved
/// scene no longer states its world.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat edit scene.ply --clean -o clean.ply
  zipsplat edit scene.ply --cameras transforms.json --min-views 2 --clean -o clean.ply
  zipsplat edit scene.ply --crop-sphere 0,0,2,1.5 --decimate 0.5 --sort -o small.spz
  zipsplat edit scene.ply --features features.safetensors --clean -o clean.ply
  zipsplat edit left.ply right.ply --min-opacity 0.05 --sh-degree 0 -o both.ply
  zipsplat edit scene.ply --cameras transforms.json --level --scale 2 -o level.glb")]
pub struct Edit {
    /// Scenes (PLY, SPZ, SOG, .splat or glTF) in one world, all antialiased or none; several are
    /// merged
    #[arg(required = true, value_name = "SCENE")]
    scenes: Vec<PathBuf>,
    /// Scene to write: .ply, .spz, .sog, .splat, .glb or .gltf
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    input: SceneInput,
    /// Cameras for --min-views, --level and --clean: transforms.json or a COLMAP model's folder
    #[arg(long, value_name = "PATH")]
    cameras: Option<PathBuf>,
    #[command(flatten)]
    world_photo: WorldPhoto,
    /// Features of the scenes, of `lift`, one file each; the edited scene's are written beside it,
    /// as .safetensors
    #[arg(long, value_name = "FILE", num_args = 1..)]
    features: Vec<PathBuf>,
    #[command(flatten)]
    edits: Edits,
}

/// Edits in the order of the command line.
struct Edits(Vec<Operation>);

/// Help, in the order of [`Operation::FORMS`].
const HELP: [&str; 14] = [
    "Keep centers between the lower and the upper corner of a box",
    "Keep centers in a sphere",
    "Move the scene",
    "Rotate about the origin: degrees about x, then y, then z",
    "Scale about the origin",
    "Rotate about the origin: the cameras' mean up becomes -y",
    "Drop Gaussians with less opacity",
    "Drop Gaussians with a larger standard deviation",
    "Drop Gaussians with fewer than N others within RADIUS",
    "Drop Gaussians whose center is in the pictures of fewer than N cameras, occluded or not",
    "Drop floaters: faint, isolated, or far outside the pictures of --cameras",
    "Lower the degree of spherical harmonics",
    "Merge similar neighbors until N Gaussians, or a fraction, are left",
    "Sort by opacity times the two largest scales, largest first",
];

impl Args for Edits {
    fn augment_args(command: Command) -> Command {
        let arg = |((name, form), help): ((&'static str, &'static str), &'static str)| {
            let arg = Arg::new(name).long(name).help(help).action(ArgAction::Append).help_heading("Edits");
            match form {
                "" => arg.num_args(0).default_missing_value(""),
                form => arg.value_name(form).allow_hyphen_values(true),
            }
        };
        command.args(Operation::FORMS.into_iter().zip(HELP).map(arg))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Edits {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut edits = Vec::new();
        for (name, _) in Operation::FORMS {
            let values = matches.get_many::<String>(name).into_iter().flatten();
            for (at, text) in matches.indices_of(name).into_iter().flatten().zip(values) {
                let invalid = |error: String| clap::Error::raw(ErrorKind::ValueValidation, format!("--{error}\n"));
                let numbers: Result<Vec<f64>, _> =
                    text.split(',').filter(|_| !text.is_empty()).map(|number| number.trim().parse()).collect();
                let numbers = numbers.map_err(|_| invalid(format!("{name}: found {text}, expected numbers")))?;
                edits.push((at, Operation::new(name, &numbers).map_err(|error| invalid(error.to_string()))?));
            }
        }
        edits.sort_by_key(|(at, _)| *at);
        Ok(Self(edits.into_iter().map(|(_, edit)| edit).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        Self::from_arg_matches(matches).map(|edits| *self = edits)
    }
}

impl Edit {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let edits = &self.edits.0;
        self.overwrite.check_scene(&self.output)?;
        if edits.is_empty() && self.scenes.len() == 1 {
            return Err(Error::argument("edits", "none of one scene", "an edit, such as --clean, or several scenes"));
        }
        if let Some(edit) = edits.iter().find(|edit| edit.needs_cameras() && self.cameras.is_none()) {
            return Err(Error::argument(format!("--{}", edit.name()), "no cameras", "--cameras FILE"));
        }
        let features_file = self.output.with_extension("safetensors");
        if !self.features.is_empty() {
            self.overwrite.check_file(&features_file)?;
        }
        let (scene, features, dropped, world) = self.merged(session)?;
        let cameras = self.cameras(session, world.as_ref())?;
        let (Edited { scene: edited, mut sources, reports }, _) =
            session.stage("edit", |_| scene.edit(edits, &cameras))?;
        let world = world.filter(|_| !edits.iter().any(Operation::moves));
        session.notes(outputs::save_scene(&self.output, &edited, &SaveOptions::default(), world.as_ref())?);
        if let Some(features) = features {
            if let Some(order) = SceneFormat::of_extension(&self.output).and_then(|format| format.order(&edited)) {
                sources = order.iter().map(|i| sources[*i]).collect();
            }
            // Formats round values: the hash is that of the scene as read.
            lifted::save(&features_file, &features.of(&sources), &Scene::open(&self.output)?)?;
        }
        let written = size_of(&self.output)?;
        let json = json!({
            "output": self.output.to_string_lossy(), "gaussians": edited.len(), "input_gaussians": scene.len(), "dropped": dropped,
            "edits": reports, "bytes": written,
        });
        let mut table = Table::new(2, &["edit", "effect", "before", "after"]);
        for report in reports {
            let [before, after] = [report.before, report.after].map(|count| HumanCount(count as u64).to_string());
            table.row([report.edit.into(), report.effect, before, after]);
        }
        let text = format!("{}: {}, {}", self.output.display(), counted(edited.len(), "Gaussian"), bytes(written));
        session.report(&json, if edits.is_empty() { text } else { format!("{text}\n{table}") })
    }

    /// Reads the scenes and their features. Their world is kept if all have the same.
    fn merged(&self, session: &mut Session<'_>) -> Result<(Scene, Option<Lifted>, usize, Option<World>)> {
        lifted::check_count(&self.features, &self.scenes)?;
        let (mut merged, mut dropped) = self.input.read(session, &self.scenes[0])?;
        let mut features = self.features.first().map(|path| lifted::open(path, &merged)).transpose()?;
        let mut world = read_world(&self.scenes[0])?;
        for (i, path) in self.scenes.iter().enumerate().skip(1) {
            let (scene, invalid) = self.input.read(session, path)?;
            if let Some(merged) = &mut features {
                merged.append(&lifted::open(&self.features[i], &scene)?)?;
            }
            if read_world(path)?.map(|world| world.origin) != world.as_ref().map(|world| world.origin.clone()) {
                let first = self.scenes[0].display();
                session.note(format!("{} states another world than {first}: merged as they are", path.display()));
                world = None;
            }
            merged = Scene::concat(merged, scene)?;
            dropped += invalid;
        }
        Ok((merged, features, dropped, world))
    }

    fn cameras(&self, session: &mut Session<'_>, world: Option<&World>) -> Result<Vec<Camera>> {
        let Some(path) = &self.cameras else { return Ok(Vec::new()) };
        let capture = Capture::open(path)?;
        session.notes(&capture.warnings);
        let (to_scene, note) = to_scene(self.world_photo.relative_to.as_deref(), &capture, world, path)?;
        session.notes(note);
        Ok(capture.frames.iter().map(|frame| to_scene.apply(&frame.upright_camera())).collect())
    }
}
