//! Arithmetic that is measured for its own sake.

pub mod copy;
pub mod fma;
pub mod matrix;
