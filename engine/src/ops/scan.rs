//! Prefix sums in two dispatches, without waiting workgroups.

use crate::{
    gpu::{Limits, Recorder, Tensor},
    kernels::ops::{ScanApply, ScanReduce},
};

/// Each block sums those before it.
const MAX_BLOCKS: usize = 1024;

/// Least items of a block, and overlapping loads per lane. CPUs have few cores and short latencies.
pub(super) fn block_shape(limits: &Limits) -> (usize, u32) {
    if limits.cpu { (1024, 1) } else { (256, (256 / limits.subgroup_size).clamp(1, 8)) }
}

/// Replaces the first `count` u32 by exclusive prefix sums modulo 2^32.
pub fn exclusive_scan(rec: &mut Recorder, values: Tensor, count: usize) {
    let (share, rounds) = block_shape(rec.limits());
    let blocks = count.div_ceil(share).min(MAX_BLOCKS);
    let count = u32::try_from(count).expect("bindings hold fewer than 2^32 words");
    rec.scope("scan", |rec| {
        let sums = rec.tensor::<u32>("sums", blocks);
        rec.dispatch_groups(ScanReduce { values, sums, count, blocks: blocks as u32 }, blocks);
        rec.dispatch_groups(ScanApply { values, sums, count, blocks: blocks as u32, rounds }, blocks);
    });
}
