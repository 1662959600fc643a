//! Depth Anything 3: a class token that becomes a camera token, global patches without positions.

mod camera_encoder;
mod transformer;

pub use transformer::interpolate_positions;
pub(super) use transformer::transformer;
