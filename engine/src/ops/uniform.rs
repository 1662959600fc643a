//! Shapes of kernels with uniform loads across lanes (kernels/shared/uniform.glsl).

use crate::{gpu::Limits, kernels::limits::PANEL_COLUMNS};

/// Rows per workgroup and vectors per lane: sums fit a CPU's 16 vector registers.
pub(crate) const UNIFORM_TILE: [u32; 2] = [6, 2];

/// Whether the device has buffer addresses and whole workgroups divide a panel.
pub(crate) fn divides_panels(limits: &Limits) -> bool {
    limits.addresses && PANEL_COLUMNS.is_multiple_of(UNIFORM_TILE[1] * limits.subgroup_size)
}

/// Unrolled terms of a loop over `width`, a multiple of 4. More terms mean fewer masked sums but
/// longer compilation.
pub(crate) fn terms_of(width: usize) -> u32 {
    [32, 16, 12, 8].into_iter().find(|terms| width.is_multiple_of(*terms)).unwrap_or(4) as u32
}
