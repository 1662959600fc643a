//! `zipsplat convert`: checkpoints to safetensors.

use crate::{outputs, session::Session, table::bytes};
use clap::Args;
use indicatif::HumanCount;
use serde_json::json;
use std::path::PathBuf;
use zipsplat::{
    Error, Result,
    weights::{Checkpoint, Dtype},
};

/// A checkpoint (PyTorch, safetensors or seeded) to safetensors that name their network
#[derive(Args)]
#[command(after_help = "Examples:
  zipsplat convert zipsplat.pt zipsplat.safetensors --dtype f16
  zipsplat convert tensors.safetensors named.safetensors --variant vitb
  zipsplat convert seeded:vits random.safetensors")]
pub struct Convert {
    /// Checkpoint, or seeded:VARIANT[:KEY]
    input: String,
    /// File to write
    output: PathBuf,
    /// Numbers: f32, f16 or bf16
    #[arg(long, value_name = "TYPE", default_value = "f32")]
    dtype: String,
    /// Network of a checkpoint that does not say: vits, vitb, vitl or vitg
    #[arg(long, value_name = "V")]
    variant: Option<String>,
}

impl Convert {
    pub fn run(&self, session: &mut Session<'_>) -> Result<()> {
        let dtype: Dtype = self.dtype.parse()?;
        outputs::check_file(&self.output)?;
        let checkpoint = Checkpoint::parse(&self.input, self.variant.as_deref())?;
        session.stage("convert", |stage| checkpoint.save_with(&self.output, dtype, |done| stage.at(done)))?;
        let written = self.output.metadata().map_err(|error| Error::io(&self.output, error))?.len();
        let architecture = checkpoint.architecture();
        let json = json!({
            "output": self.output, "architecture": architecture, "parameters": architecture.parameter_count(),
            "dtype": dtype.name(), "bytes": written,
        });
        let text = format!(
            "{}: {}, {} parameters in {}, {}",
            self.output.display(),
            architecture.name,
            HumanCount(architecture.parameter_count() as u64),
            dtype.name(),
            bytes(written)
        );
        session.report(&json, text)
    }
}
