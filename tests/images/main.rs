//! Pictures against truth.

mod effects;
mod properties;
mod render;
