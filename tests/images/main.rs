//! Pictures against truth.

mod effects;
mod precision;
mod properties;
mod range;
mod render;
