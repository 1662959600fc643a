//! The shape of kernels whose lanes all load the same (kernels/shared/uniform.glsl).

use crate::{gpu::Limits, kernels::limits::PANEL_COLUMNS};

/// Rows of a workgroup, and vectors of a lane: sums that stay in the 16 vector registers of a CPU.
pub(crate) const UNIFORM_TILE: [u32; 2] = [6, 2];

/// True where the device reads by address, and whole workgroups divide a panel.
pub(crate) fn divides_panels(limits: &Limits) -> bool {
    limits.addresses && PANEL_COLUMNS.is_multiple_of(UNIFORM_TILE[1] * limits.subgroup_size)
}

/// Terms of one pass of a loop over a width, whole vectors of 4: the more, the fewer times sums are masked,
/// and the longer the driver compiles.
pub(crate) fn terms_of(width: usize) -> u32 {
    [32, 16, 12, 8].into_iter().find(|terms| width.is_multiple_of(*terms)).unwrap_or(4) as u32
}
