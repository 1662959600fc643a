pub mod copy;
pub mod fma;
pub mod matrix;
