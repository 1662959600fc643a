use crate::{
    options::{CHECKPOINTS, SceneInput, open_checkpoint, refuse},
    outputs::{self, Overwrite},
    released::{is_of_depth, open_depth},
    session::Session,
    table::{bytes, counted},
};
use clap::Args;
use indicatif::HumanCount;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use zipsplat::{
    Error, Result,
    types::{SaveOptions, SceneFormat, read_world, spz_coarsening},
    weights::Dtype,
};

/// Convert a scene's format, or a checkpoint (PyTorch, safetensors or seeded) to safetensors
///
/// Reads a scene by its first bytes (.splat and .gltf by name), and writes the format of the
/// output's name. Coordinates stay. All formats except .splat keep the photo whose camera is the
/// world.
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat convert scene.ply scene.spz
  zipsplat convert scene.spz scene.glb
  zipsplat convert zipsplat.pt zipsplat.safetensors --dtype f16
  zipsplat convert zipsplat.pt small.safetensors --dtype q8
  zipsplat convert builtin small.safetensors --dtype q8
  zipsplat convert tensors.safetensors named.safetensors --variant vitb
  zipsplat convert model.safetensors da3-base.safetensors --dtype f16
  zipsplat convert seeded:vits random.safetensors")]
pub struct Convert {
    /// Scene (PLY, SPZ, .splat or glTF), checkpoint of ZipSplat or Depth Anything 3, a name of
    /// `zipsplat weights list`, or seeded:VARIANT[:KEY]
    input: String,
    /// File to write
    output: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    #[command(flatten)]
    scene_input: SceneInput,
    /// Type of a checkpoint: f32, f16, bf16, or q8, 8-bit matrices with a scale per 32 values
    /// [default: f32]
    #[arg(long, value_name = "TYPE")]
    dtype: Option<String>,
    /// Network of an unnamed checkpoint: vitg (DA3-Giant, the only one with released weights),
    /// vits, vitb, vitl, or the reference's da3s, da3b, da3l; with further fields as in
    /// vits:out_layers=5,7,11:alt_start=5:rope_start=5
    #[arg(long, value_name = "V")]
    variant: Option<String>,
    /// SPZ version: 2, 3, or 4, for older to newer readers [default: 3]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..=4))]
    spz_version: Option<u32>,
}

impl Convert {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        self.overwrite.check_file(&self.output)?;
        // The checkpoint reader reports unreadable files.
        let input = SceneFormat::of_file(Path::new(&self.input)).unwrap_or(None);
        match (SceneFormat::of_extension(&self.output), input) {
            (Some(output), _) => self.scene(session, output),
            (None, Some(_)) => {
                Err(Error::argument("output of a scene", self.output.display(), SceneFormat::EXTENSIONS))
            }
            (None, None) => self.checkpoint(session),
        }
    }

    fn scene(&self, session: &mut Session<'_>, output: SceneFormat) -> Result<()> {
        refuse("--dtype", self.dtype.is_some(), "a scene", "a checkpoint")?;
        refuse("--variant", self.variant.is_some(), "a scene", "a checkpoint")?;
        let is_spz = output == SceneFormat::Spz;
        refuse("--spz-version", self.spz_version.is_some() && !is_spz, "another format", "an SPZ as output")?;
        let (scene, dropped) = self.scene_input.read(session, Path::new(&self.input))?;
        if scene.sh_degree > 0 && !output.keeps_view_dependence() {
            session.note("a .splat keeps one color a Gaussian: how it changes with the direction is left out");
        }
        if let Some(note) = Some(&scene).filter(|_| is_spz).and_then(spz_coarsening) {
            session.note(note);
        }
        let options = SaveOptions { spz_version: self.spz_version.unwrap_or(SaveOptions::default().spz_version) };
        let world = read_world(&self.input)?;
        let save = || outputs::save_scene(&self.output, &scene, &options, world.as_ref());
        let (note, _) = session.stage("write scene", |_| save())?;
        note.into_iter().for_each(|note| session.note(note));
        let written = self.written()?;
        let json = json!({ "output": self.output, "gaussians": scene.len(), "dropped": dropped, "bytes": written });
        let text = format!("{}: {}, {}", self.output.display(), counted(scene.len(), "Gaussian"), bytes(written));
        session.report(&json, text)
    }

    fn checkpoint(&self, session: &mut Session<'_>) -> Result<()> {
        refuse("--spz-version", self.spz_version.is_some(), "a checkpoint", "a scene")?;
        refuse("--drop-invalid", self.scene_input.is_given(), "a checkpoint", "a scene")?;
        let dtype: Dtype = self.dtype.as_deref().unwrap_or("f32").parse()?;
        if is_of_depth(&self.input) {
            return self.depth_checkpoint(session, dtype);
        }
        let checkpoint = open_checkpoint(&self.input, self.variant.as_deref(), CHECKPOINTS)?;
        checkpoint.notes().iter().for_each(|note| session.note(note));
        session.stage("convert", |stage| checkpoint.save_with(&self.output, dtype, |done| stage.at(done)))?;
        let architecture = checkpoint.architecture();
        self.report(session, &architecture.name, json!(architecture), architecture.parameter_count(), dtype)
    }

    fn depth_checkpoint(&self, session: &mut Session<'_>, dtype: Dtype) -> Result<()> {
        refuse("--variant", self.variant.is_some(), "weights of Depth Anything 3", "weights of ZipSplat")?;
        let checkpoint = open_depth(&self.input, true)?;
        session.stage("convert", |stage| checkpoint.save_with(&self.output, dtype, |done| stage.at(done)))?;
        let architecture = checkpoint.architecture();
        self.report(session, &architecture.name, json!(architecture), architecture.parameter_count(), dtype)
    }

    fn report(
        &self,
        session: &mut Session<'_>,
        name: &str,
        architecture: Value,
        parameters: usize,
        dtype: Dtype,
    ) -> Result<()> {
        let written = self.written()?;
        let json = json!({
            "output": self.output, "architecture": architecture, "parameters": parameters, "dtype": dtype.name(), "bytes": written,
        });
        let (output, count) = (self.output.display(), HumanCount(parameters as u64));
        let text = format!("{output}: {name}, {count} parameters in {}, {}", dtype.name(), bytes(written));
        session.report(&json, text)
    }

    fn written(&self) -> Result<u64> {
        Ok(self.output.metadata().map_err(|error| Error::io(&self.output, error))?.len())
    }
}
