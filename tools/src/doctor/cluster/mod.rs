//! Clustering: the nearest target, and k-means as a whole.

mod kmeans;
mod nearest;

pub use kmeans::area as kmeans;
pub use nearest::area as nearest;

use super::Mode;
use zipsplat::{gpu::Device, ops::NearestKernel};

/// The kernel that finds nearest rows in a mode.
fn kernel(mode: Mode, device: &Device) -> NearestKernel {
    mode.units(device).map_or(NearestKernel::Lanes, NearestKernel::Matrix)
}
