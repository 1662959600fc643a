//! Depth from photos, by Depth Anything 3 or VGGT.

mod gaussians;
mod model;
mod network;
mod output;
mod pixels;
mod points;

pub use gaussians::pixel_gaussians;
pub use model::{DepthModel, DepthOptions};
pub use network::{DepthNetwork, DepthShape, DepthTensors};
pub use output::{CameraSource, DepthMap, DepthPrediction, METRIC_FOCAL};
pub use pixels::add_view;
