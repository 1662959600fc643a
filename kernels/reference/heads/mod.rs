//! Parts of the heads of Depth Anything 3.

pub mod convolution;
pub mod pixel_shuffle;
pub mod resize;
