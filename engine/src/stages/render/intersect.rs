//! A depth sort, then a tile sort; both are stable, so the longer list needs few bits.

use super::{FrameShape, project::Splats};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::render::{Intersect, TileCounts},
    ops::{
        scan::exclusive_scan,
        sort::{key_bits, key_starts, sort_pairs},
    },
};

pub(super) struct TileLists {
    /// `[capacity]` pairs.
    pub pair_indices: Tensor,
    /// `[tiles + 1]`.
    pub tile_offsets: Tensor,
    pub status: Tensor,
}

/// Positive f32 sort as integers.
const DEPTH_BITS: u32 = 31;

pub(super) fn record(rec: &mut Recorder, splats: &Splats, shape: FrameShape, capacity: usize) -> TileLists {
    let pairs = u32::try_from(splats.pairs).expect("bindings hold fewer than 2^32 words");
    let tile_sets = splats.tile_sets;

    let pair_count = rec.tensor::<u32>("pair_count", 1);
    rec.fill(pair_count, pairs);
    let (_, indices) = rec.scope("by_depth", |rec| {
        sort_pairs(rec, splats.depths, splats.indices, pair_count, splats.pairs.max(1), DEPTH_BITS)
    });

    let offsets = rec.tensor::<u32>("offsets", splats.pairs + 1);
    rec.dispatch(TileCounts { tile_sets, indices, tile_counts: offsets, pairs }, splats.pairs + 1);
    exclusive_scan(rec, offsets, splats.pairs + 1);

    let tiles = rec.tensor::<u32>("tiles", capacity);
    let pair_indices = rec.tensor::<u32>("pair_indices", capacity);
    let status = rec.tensor::<u32>("status", 3);
    rec.fill(status, 0);
    let kernel = Intersect {
        tile_sets,
        indices,
        offsets,
        tiles,
        pair_indices,
        status,
        pairs,
        camera_count: shape.cameras as u32,
        grid: shape.grid(),
        capacity: u32::try_from(capacity).expect("bindings hold fewer than 2^32 words"),
    };
    rec.dispatch(kernel, splats.pairs + 1);

    let tile_count = shape.tiles();
    let (tiles, pair_indices) =
        rec.scope("by_tile", |rec| sort_pairs(rec, tiles, pair_indices, status, capacity, key_bits(tile_count)));
    let tile_offsets = key_starts(rec, tiles, status, tile_count);
    TileLists { pair_indices, tile_offsets, status }
}
