//! Heads of Depth Anything 3 and VGGT.

pub mod convolution;
pub mod modulate;
pub mod pixel_shuffle;
pub mod resize;
