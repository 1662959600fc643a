//! ZipSplat in plain f64, the reference of tests and `zipsplat doctor`.
//!
//! Modules mirror the kernels, without tiling, fusion or streaming, to share no mistake.
//! Activations are row-major `[f64]`, weights f32.
#![allow(missing_docs, reason = "read with the code: names and shapes document most items")]

pub mod backbone;
pub mod cluster;
pub mod depth;
pub mod features;
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
pub mod vggt;

pub fn widen(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}
