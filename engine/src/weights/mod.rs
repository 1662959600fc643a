//! Checkpoints from files or seeds.
//!
//! Reads safetensors and `torch.save` archives, writes safetensors. 8-bit tensors NAME are stored
//! as NAME.q8, I8 `[columns, inner]`, and NAME.q8_scales, F16 `[columns, inner / 32]`.

mod checkpoint;
mod contents;
mod depth;
mod inference;
mod pickle;
mod safetensors;
mod save;
mod seeded;
mod source;
mod tensor;
mod torch;
mod values;
mod variant;

use std::path::Path;

pub use checkpoint::Checkpoint;
pub use depth::{DepthCheckpoint, DepthHeads};
pub use tensor::Dtype;
pub use values::Values;

use crate::Result;
pub use crate::{
    ops::{Ffn, Q8},
    stages::{Architecture, DEPTH_MODELS, DepthArchitecture, RECIPES, VARIANTS},
};

/// Converts a checkpoint to safetensors.
pub fn convert(input: impl AsRef<Path>, output: impl AsRef<Path>, dtype: Dtype, variant: Option<&str>) -> Result<()> {
    Checkpoint::open(input, variant)?.save(output, dtype)
}
