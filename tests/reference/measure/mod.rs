//! Arithmetic that is measured for its own sake.

pub mod fma;
pub mod matrix;
