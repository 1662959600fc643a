//! Pictures against truth.

mod precision;
mod render;
