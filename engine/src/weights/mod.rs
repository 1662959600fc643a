//! Checkpoints: files or seeds in, checked and shaped f32 tensors out.
//!
//! [`Architecture`] says which tensors a model has; [`Checkpoint`] has exactly those, or could not be made.
//! Read are safetensors and the zip archives of `torch.save`; written are safetensors that name their architecture.
//! Weights of 8 bits lie in such a file under names of their own: for a tensor NAME `[columns, inner]`, NAME.q8, I8 of that shape,
//! and NAME.q8_scales, F16 `[columns, inner / 32]`.

mod checkpoint;
mod contents;
mod depth;
mod inference;
mod pickle;
mod safetensors;
mod seeded;
mod tensor;
mod tensors;
mod torch;
mod variant;

use std::path::Path;

pub use checkpoint::Checkpoint;
pub use depth::DepthCheckpoint;
pub use tensor::Dtype;
pub use tensors::Tensors;

use crate::Result;
pub use crate::{
    ops::{Ffn, Q8},
    stages::{Architecture, DEPTH_MODELS, DepthArchitecture, RECIPES, VARIANTS},
};

/// Writes the checkpoint `input` (PyTorch or safetensors) as safetensors of one type with its architecture as metadata.
///
/// `output` appears whole or not at all. `variant` is as in [`Checkpoint::open`]. Errors are those of
/// [`Checkpoint::open`] and [`Checkpoint::save`].
pub fn convert(input: impl AsRef<Path>, output: impl AsRef<Path>, dtype: Dtype, variant: Option<&str>) -> Result<()> {
    Checkpoint::open(input, variant)?.save(output, dtype)
}
