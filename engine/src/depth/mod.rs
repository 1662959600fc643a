//! Photos to depth, rays and cameras, by the networks of Depth Anything 3.

mod gaussians;
mod model;
mod output;
mod points;

pub use gaussians::pixel_gaussians;
pub use model::{DepthModel, DepthRequest, DepthShape, DepthTensors};
pub use output::{DepthView, Depths};
