//! Pictures against truth.

mod render;
