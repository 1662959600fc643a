//! Image losses.

pub mod gradient;
