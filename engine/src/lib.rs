//! ZipSplat on Vulkan: photos without poses to a compact 3D Gaussian scene in one forward pass.
//!
//! Layers use only what stands before them: `gpu` <- `types` <- `ops` <- `stages` <- `refine` <- `reconstruct` <- `ffi`.

mod error;
pub mod ffi;
pub mod gpu;
pub mod ops;
pub mod reconstruct;
pub mod refine;
pub mod stages;
pub mod types;
pub mod weights;

/// The typed kernel table that build.rs makes of `kernels/`.
pub mod kernels {
    #![allow(clippy::too_many_arguments, missing_docs)]
    include!(concat!(env!("OUT_DIR"), "/kernels.rs"));
}

pub use error::{Error, Result};
