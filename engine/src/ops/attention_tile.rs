//! How attention on matrix units is cut into workgroups.

use super::{Units, tile::TILES};
use crate::gpu::{Limits, MatrixShape};
use std::fmt;

/// The share of an attention that a workgroup of ops/attention_matrix owns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AttentionTile {
    /// Subgroups, each with its own queries.
    pub subgroups: u32,
    /// Matrices that a subgroup's queries fill.
    pub repeat: u32,
    /// Keys and values in shared memory.
    pub keys: u32,
}

impl AttentionTile {
    /// Channels of the heads that are measured: those of every DA3 network.
    pub(super) const TUNED_CHANNELS: usize = 64;

    /// Shapes to choose from for heads of `channels`, those by rule first, the larger first. A subgroup has 16 or 32 queries:
    /// every matrix of keys and values that is loaded is multiplied once or twice. Once is the rule, since twice leaves an H100
    /// too few registers and takes 1.6 times as long there.
    pub fn candidates(limits: &Limits, units: Units, channels: usize) -> Vec<Self> {
        let shape = units.shape;
        let sides: &[u32] = if limits.cpu { &[8] } else { &[16, 32] };
        let tiles = sides.iter().flat_map(|side| {
            let repeat = side.div_ceil(shape.m);
            // Every lane turns 8 scores of a row, or more, into 16 bytes of weights.
            let row_lanes = (limits.subgroup_size / (repeat * shape.m)).max(1);
            let keys = (2 * shape.n.max(shape.k)).max(8 * row_lanes);
            [4, 2, 1].map(|subgroups| Self { subgroups, repeat, keys })
        });
        tiles.filter(|tile| tile.fits(limits, shape, channels)).collect()
    }

    /// The tile that was measured to be fastest; by rule, among those with as few matrices a subgroup as the first, the largest
    /// that leaves enough of them to keep the device busy, else the smallest.
    ///
    /// # Panics
    /// Where none fits; [`AttentionTile::candidates`] says so.
    pub(super) fn choose(limits: &Limits, units: Units, channels: usize, queries: usize, heads: usize) -> Self {
        let candidates = Self::candidates(limits, units, channels);
        let busy = |tile: &&Self| queries.div_ceil(tile.rows(units.shape)) * heads >= TILES;
        let tuned = Self::candidates(limits, units, Self::TUNED_CHANNELS);
        let measured = units.tiles.of(queries * heads * channels).and_then(|index| tuned.get(index));
        let mut ruled = candidates.iter().filter(|tile| tile.repeat == candidates[0].repeat);
        // Wide heads do not fit every tile.
        let tile = measured.filter(|tile| candidates.contains(tile)).or(ruled.clone().find(busy));
        *tile.or(ruled.next_back()).expect("matrix units are used where a tile fits")
    }

    /// Queries of a workgroup.
    pub fn rows(&self, shape: MatrixShape) -> usize {
        (self.subgroups * self.repeat * shape.m) as usize
    }

    /// Queries of the largest workgroup.
    pub(super) fn most_rows(limits: &Limits, units: Units) -> usize {
        let tiles = Self::candidates(limits, units, 8);
        tiles.iter().map(|tile| tile.rows(units.shape)).max().unwrap_or(0)
    }

    /// Whether a workgroup is within the device's limits, its shared memory as kernels/ops/attention_matrix.comp lays it
    /// out.
    fn fits(&self, limits: &Limits, shape: MatrixShape, channels: usize) -> bool {
        let values = 2 * self.keys * (channels as u32 / 8 + 1);
        let scores = self.rows(shape) as u32 * (self.keys / 4 + 1);
        16 * (values + scores) <= limits.shared_bytes && self.subgroups * limits.subgroup_size <= limits.max_invocations
    }
}

impl fmt::Display for AttentionTile {
    /// Subgroups, matrices, keys.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { subgroups, repeat, keys } = self;
        write!(f, "{subgroups} of {repeat}, {keys} keys")
    }
}

#[cfg(test)]
mod tests {
    use super::{super::tile::Tiles, *};
    use crate::gpu::Element;

    #[test]
    fn few_queries_get_small_tiles_and_only_measuring_gets_several_matrices_a_subgroup() {
        let limits = Limits::default();
        let units = Units::of(Element::F16, &limits).expect("an ordinary device has matrix units");
        let choose = |units, queries, heads| AttentionTile::choose(&limits, units, 64, queries, heads);
        let tiles = AttentionTile::candidates(&limits, units, AttentionTile::TUNED_CHANNELS);
        assert_eq!([(1, 1), (60_000, 24)].map(|(q, h)| choose(units, q, h).subgroups), [1, 4]);
        assert!([(1, 1), (300, 16), (60_000, 24)].iter().all(|&(q, h)| choose(units, q, h).repeat == 1));
        assert!(tiles.iter().any(|tile| tile.repeat == 2));
        for (index, tile) in tiles.iter().enumerate() {
            let units = Units { tiles: Tiles::always(index), ..units };
            // Also for heads of other sizes, as far as it fits them.
            assert_eq!([16, 64].map(|channels| AttentionTile::choose(&limits, units, channels, 300, 16)), [*tile; 2]);
        }
    }
}
