//! Clustering: nearest targets and k-means.

mod kmeans;
mod nearest;

pub use kmeans::area as kmeans;
pub use nearest::area as nearest;

use crate::Mode;
use zipsplat::{gpu::Device, ops::NearestKernel};

fn kernel(mode: Mode, device: &Device) -> NearestKernel {
    mode.units(device).map_or(NearestKernel::Lanes, NearestKernel::Matrix)
}
