use crate::{gpu::Limits, kernels::limits::PANEL_COLUMNS};

/// Rows per workgroup and vectors per lane, for a CPU's 16 registers.
pub(crate) const UNIFORM_TILE: [u32; 2] = [6, 2];

/// Queries per workgroup and key vectors per lane of attention. CPUs with 16 lanes have 32
/// registers.
pub(crate) fn attention_tile(limits: &Limits) -> [u32; 2] {
    [UNIFORM_TILE[0], if limits.subgroup_size < 16 { UNIFORM_TILE[1] } else { 4 }]
}

pub(crate) fn divides_panels(limits: &Limits) -> bool {
    limits.addresses && PANEL_COLUMNS.is_multiple_of(UNIFORM_TILE[1] * limits.subgroup_size)
}

/// Unrolled terms: more cost compile time, fewer cost masking.
pub(crate) fn terms_of(width: usize) -> u32 {
    [32, 16, 12, 8].into_iter().find(|terms| width.is_multiple_of(*terms)).unwrap_or(4) as u32
}
