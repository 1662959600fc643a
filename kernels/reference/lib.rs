//! ZipSplat again in plain f64: dense, sequential in its definitions, and as short as the formulas allow.
//!
//! The tests and `zipsplat doctor` hold the engine to it; the engine never sees it. Modules mirror the kernels. Nothing here is tiled, fused or streamed, so that a kernel and its reference cannot share
//! a mistake. Activations are `[f64]`, row-major; weights stay the f32 they are stored as. `stages/references.rs` holds
//! every reference to the dumps of the PyTorch implementation.

pub mod backbone;
pub mod cluster;
pub mod depth;
pub mod forward;
pub mod fuse;
pub mod gaussians;
pub mod heads;
pub mod loss;
pub mod lpips;
pub mod measure;
pub mod model;
pub mod ops;
pub mod refine;
pub mod render;

/// f32 values as the references take them.
pub fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}
