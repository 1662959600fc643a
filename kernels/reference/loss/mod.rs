//! Image losses.

pub mod gradient;
pub mod targets;
