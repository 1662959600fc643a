//! Pictures against truth.

mod effects;
mod precision;
mod properties;
mod render;
