//! Depth Anything 3 heads.

pub mod convolution;
pub mod pixel_shuffle;
pub mod resize;
