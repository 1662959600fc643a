//! Refinement.

pub mod adam;
