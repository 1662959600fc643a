//! Prefix sums in two dispatches, without waiting workgroups.

use crate::{
    gpu::{Recorder, Tensor},
    kernels::ops::{ScanApply, ScanReduce},
};

const SHARE: usize = 1024;
const MAX_BLOCKS: usize = 1024;

/// Replaces the first `count` u32 by exclusive prefix sums modulo 2^32.
pub fn exclusive_scan(rec: &mut Recorder, values: Tensor, count: usize) {
    let blocks = count.div_ceil(SHARE).min(MAX_BLOCKS);
    let count = u32::try_from(count).expect("bindings hold fewer than 2^32 words");
    rec.scope("scan", |rec| {
        let sums = rec.tensor::<u32>("sums", blocks);
        rec.dispatch_groups(ScanReduce { values, sums, count, blocks: blocks as u32 }, blocks);
        rec.dispatch_groups(ScanApply { values, sums, count, blocks: blocks as u32 }, blocks);
    });
}
