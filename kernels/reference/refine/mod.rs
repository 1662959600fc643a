//! Refinement.

pub mod adam;
pub mod anisotropy;
