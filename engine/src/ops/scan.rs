//! Prefix sums: each workgroup adds up its share, then scans it on top of the shares before it. Two dispatches for any
//! length, and no workgroup ever waits for another.

use crate::{
    gpu::{Recorder, Tensor},
    kernels::ops::{ScanApply, ScanReduce},
};

/// Items that a workgroup should have at least.
const SHARE: usize = 1024;
/// Workgroups at most: each reads the sums of all before it.
const MAX_BLOCKS: usize = 1024;

/// Records the replacement of each of the first `count` u32 of `values` by the sum of all before it, modulo 2^32.
pub fn exclusive_scan(rec: &mut Recorder, values: Tensor, count: usize) {
    let blocks = count.div_ceil(SHARE).min(MAX_BLOCKS);
    let count = u32::try_from(count).expect("bindings hold fewer than 2^32 words");
    rec.scope("scan", |rec| {
        let sums = rec.tensor::<u32>("sums", blocks);
        rec.dispatch_groups(ScanReduce { values, sums, count, blocks: blocks as u32 }, blocks);
        rec.dispatch_groups(ScanApply { values, sums, count, blocks: blocks as u32 }, blocks);
    });
}
