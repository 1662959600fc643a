//! ZipSplat on Vulkan: photos without poses to a compact 3D Gaussian scene in one forward pass.
//!
//! Layers use only what stands before them: `gpu` <- `types` <- `ops` <- `stages` <- `reconstruct`.

mod error;
pub mod types;
pub mod weights;

pub use error::{Error, Result};
