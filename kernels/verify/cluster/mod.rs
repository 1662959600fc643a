mod kmeans;
pub mod nearest;

pub use kmeans::area as kmeans;
pub use nearest::{area as nearest_area, shapes as nearest_shapes};

use crate::Mode;
use zipsplat::{gpu::Device, ops::NearestKernel};

fn kernel(mode: Mode, device: &Device) -> NearestKernel {
    mode.units(device).map_or(NearestKernel::Lanes, NearestKernel::Matrix)
}
