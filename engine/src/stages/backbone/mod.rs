//! Backbones: pixels to tokens.

mod da3;

pub use da3::{Da3, DepthBackbone, interpolate_positions, rotary_tables};
