mod summary;

use crate::{
    options::DEPTH_WEIGHTS,
    options::{CHECKPOINTS, SceneInput, open_checkpoint, refuse, refuse_all},
    outputs::{self, Overwrite, size_of},
    released::{is_of_depth, open_complete_depth},
    session::Session,
    table::{bytes, counted},
};
use clap::Args;
use indicatif::HumanCount;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    types::{SaveOptions, SceneFormat, read_world},
    weights::Dtype,
};

/// Convert scenes between formats and checkpoints to safetensors, or summarize a file
///
/// Detects a scene's format by its first bytes (.splat, .sog and .gltf by extension). Coordinates
/// do not change. All formats except .splat and SPZ version 4 store the transform to the cameras'
/// world, all except .splat and glTF --antialiased.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat convert scene.ply
  zipsplat convert scene.ply scene.spz
  zipsplat convert scene.spz scene.glb
  zipsplat convert zipsplat.pt zipsplat.safetensors --dtype f16
  zipsplat convert zipsplat.pt small.safetensors --dtype q8
  zipsplat convert builtin small.safetensors --dtype q8
  zipsplat convert tensors.safetensors named.safetensors --variant vitb
  zipsplat convert model.safetensors da3-base.safetensors --dtype f16
  zipsplat convert seeded:vits random.safetensors")]
pub struct Convert {
    /// Scene (PLY, SPZ, SOG, .splat or glTF), checkpoint of ZipSplat, Depth Anything 3 or VGGT, a
    /// name of `zipsplat weights list`, or seeded:VARIANT[:KEY]
    input: String,
    /// File to write; its extension gives the format [default: none, only summarize the input]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    scene_input: SceneInput,
    /// Type of the checkpoint's values: f32, f16, bf16, or q8, 8-bit matrices with a scale per 32
    /// values [default: f32]
    #[arg(long, value_name = "TYPE")]
    dtype: Option<String>,
    /// Architecture of a checkpoint that does not name its own: vitg (DA3-Giant, the released
    /// weights), vitl, vitb, vits, da3s, da3b, da3l; with further fields as
    /// vits:out_layers=5,7,11:alt_start=5:rope_start=5
    #[arg(long, value_name = "V")]
    variant: Option<String>,
    /// SPZ version: 2, 3, or 4 [default: 3]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=4))]
    spz_version: Option<u32>,
}

impl Convert {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        // The checkpoint reader reports unreadable files.
        let input = SceneFormat::of_file(Path::new(&self.input)).unwrap_or(None);
        let Some(output) = &self.output else { return self.summarize(session, input.is_some()) };
        self.overwrite.check_file(output)?;
        match (SceneFormat::of_extension(output), input) {
            (Some(format), _) => self.scene(session, output, format),
            (None, Some(_)) => Err(Error::argument("output of a scene", output.display(), SceneFormat::EXTENSIONS)),
            (None, None) => self.checkpoint(session, output),
        }
    }

    fn summarize(&self, session: &mut Session<'_>, is_scene: bool) -> Result<()> {
        let options = [("--dtype", self.dtype.is_some()), ("--spz-version", self.spz_version.is_some())];
        refuse_all(options, "no output", "a file to write")?;
        let path = Path::new(&self.input);
        if path.is_dir() {
            let found = format!("the folder {}", path.display());
            return Err(Error::argument("file", found, "a checkpoint or scene"));
        }
        if is_scene {
            return summary::scene(session, &self.input, &self.scene_input);
        }
        self.scene_input.refuse("a checkpoint", "a scene")?;
        if is_of_depth(&self.input) {
            return summary::depth_checkpoint(session, &open_complete_depth(&self.input)?);
        }
        let expected = format!("{CHECKPOINTS}, or a scene ({})", SceneFormat::EXTENSIONS);
        summary::checkpoint(session, &open_checkpoint(&self.input, self.variant.as_deref(), &expected)?)
    }

    fn scene(&self, session: &mut Session<'_>, output: &Path, format: SceneFormat) -> Result<()> {
        let options = [("--dtype", self.dtype.is_some()), ("--variant", self.variant.is_some())];
        refuse_all(options, "a scene", "a checkpoint")?;
        let is_spz = format == SceneFormat::Spz;
        refuse("--spz-version", self.spz_version.is_some() && !is_spz, "another format", "an SPZ as output")?;
        let (scene, dropped) = self.scene_input.read(session, Path::new(&self.input))?;
        let options = SaveOptions { spz_version: self.spz_version.unwrap_or(SaveOptions::default().spz_version) };
        let world = read_world(&self.input)?;
        let save = || outputs::save_scene(output, &scene, &options, world.as_ref());
        let (notes, _) = session.stage("write scene", |_| save())?;
        session.notes(notes);
        let written = size_of(output)?;
        let json = json!({ "output": output.to_string_lossy(), "gaussians": scene.len(), "dropped": dropped, "bytes": written });
        let text = format!("{}: {}, {}", output.display(), counted(scene.len(), "Gaussian"), bytes(written));
        session.report(&json, text)
    }

    fn checkpoint(&self, session: &mut Session<'_>, output: &Path) -> Result<()> {
        refuse("--spz-version", self.spz_version.is_some(), "a checkpoint", "a scene")?;
        self.scene_input.refuse("a checkpoint", "a scene")?;
        let dtype: Dtype = self.dtype.as_deref().unwrap_or("f32").parse()?;
        if is_of_depth(&self.input) {
            refuse("--variant", self.variant.is_some(), DEPTH_WEIGHTS, "weights of ZipSplat")?;
            let checkpoint = open_complete_depth(&self.input)?;
            session.stage("convert", |stage| checkpoint.save_with(output, dtype, |done| stage.at(done)))?;
            let of = checkpoint.architecture();
            return report(session, output, &of.name, json!(of), of.parameter_count(), dtype);
        }
        let checkpoint = open_checkpoint(&self.input, self.variant.as_deref(), CHECKPOINTS)?;
        session.notes(checkpoint.notes());
        session.stage("convert", |stage| checkpoint.save_with(output, dtype, |done| stage.at(done)))?;
        let of = checkpoint.architecture();
        report(session, output, &of.name, json!(of), of.parameter_count(), dtype)
    }
}

fn report(
    session: &mut Session<'_>,
    output: &Path,
    name: &str,
    architecture: Value,
    parameters: usize,
    dtype: Dtype,
) -> Result<()> {
    let written = size_of(output)?;
    let json = json!({
        "output": output.to_string_lossy(), "architecture": architecture, "parameters": parameters, "dtype": dtype.name(), "bytes": written,
    });
    let (output, count) = (output.display(), HumanCount(parameters as u64));
    let text = format!("{output}: {name}, {count} parameters in {}, {}", dtype.name(), bytes(written));
    session.report(&json, text)
}
