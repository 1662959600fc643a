//! Stable LSD radix sort with a device-side count, dispatched by capacity.

use super::scan::{block_shape, exclusive_scan};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{
        limits::RADIX,
        ops::{KeyStarts, SortCount, SortScatter},
    },
};

const DIGIT_BITS: u32 = RADIX.ilog2();
/// Blocks bound the digit table: 1 KiB each, for at least 256 items of 8 bytes.
const CPU_BLOCKS: usize = 1024;
const GPU_BLOCKS: usize = 4096;

/// Returns `item_count[0]` of `capacity` pairs sorted by the lowest `bits` bits.
pub fn sort_pairs(
    rec: &mut Recorder,
    mut keys: Tensor,
    mut values: Tensor,
    item_count: Tensor,
    capacity: usize,
    bits: u32,
) -> (Tensor, Tensor) {
    let (share, rounds) = block_shape(rec.limits());
    let blocks = capacity.div_ceil(share).clamp(1, if rec.limits().cpu { CPU_BLOCKS } else { GPU_BLOCKS });
    let table = RADIX as usize * blocks;
    rec.scope("sort", |rec| {
        for shift in (0..bits).step_by(DIGIT_BITS as usize) {
            let digits = rec.tensor::<u32>("digits", table);
            let sorted_keys = rec.tensor::<u32>("keys", capacity);
            let sorted_values = rec.tensor::<u32>("values", capacity);
            let (blocks, mask) = (blocks as u32, (1 << (bits - shift).min(DIGIT_BITS)) - 1);
            rec.dispatch_groups(
                SortCount { keys, item_count, digit_counts: digits, shift, mask, blocks, rounds },
                blocks,
            );
            exclusive_scan(rec, digits, table);
            let scatter = SortScatter {
                keys,
                values,
                item_count,
                digit_offsets: digits,
                sorted_keys,
                sorted_values,
                shift,
                mask,
                blocks,
                rounds,
            };
            rec.dispatch_groups(scatter, blocks);
            (keys, values) = (sorted_keys, sorted_values);
        }
    });
    (keys, values)
}

/// Returns `[key_count + 1]` starts of keys among `item_count[0]` sorted `keys`.
pub fn key_starts(rec: &mut Recorder, keys: Tensor, item_count: Tensor, key_count: usize) -> Tensor {
    let starts = rec.tensor::<u32>("starts", key_count + 1);
    rec.dispatch(KeyStarts { keys, item_count, starts, key_count: key_count as u32 }, key_count + 1);
    starts
}

pub fn key_bits(count: usize) -> u32 {
    usize::BITS - count.saturating_sub(1).leading_zeros()
}
