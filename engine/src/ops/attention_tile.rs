//! How attention on matrix units is cut into workgroups.

use super::{Units, tile::TILES};
use crate::gpu::{Element, Limits, MatrixShape, WorkgroupMatrices};
use std::fmt;

/// How attention on matrix units is cut into workgroups, and which kernel computes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttentionTile {
    /// ops/attention_matrix
    Subgroups(SubgroupQueries),
    /// ops/attention_workgroup: only where [`Tuning`](super::Tuning) has found it to compute rightly, and to be faster.
    Workgroup(WorkgroupQueries),
}

/// What a workgroup of ops/attention_matrix owns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SubgroupQueries {
    /// Subgroups, each with its own queries.
    pub subgroups: u32,
    /// Matrices that a subgroup's queries fill.
    pub repeat: u32,
    /// Keys and values in shared memory.
    pub keys: u32,
}

/// What a workgroup of ops/attention_workgroup owns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkgroupQueries {
    /// Subgroups.
    pub subgroups: u32,
    /// Queries.
    pub rows: u32,
    /// Keys and values that are loaded at a time.
    pub keys: u32,
    /// What a head's channels are padded to a multiple of.
    pub granularity: u32,
}

impl AttentionTile {
    /// Shapes to choose from for heads of `channels`, those by rule first, the larger first.
    pub fn candidates(limits: &Limits, units: Units, channels: usize) -> Vec<Self> {
        let subgroups = SubgroupQueries::candidates(limits, units.shape, channels).map(Self::Subgroups);
        subgroups.chain(WorkgroupQueries::candidates(limits, units.factor, channels).map(Self::Workgroup)).collect()
    }

    /// The tile that was measured to be fastest; by rule the largest that leaves enough of them to keep the device busy, else
    /// the smallest.
    ///
    /// # Panics
    /// Where none fits; [`AttentionTile::candidates`] says so.
    pub(super) fn choose(limits: &Limits, units: Units, channels: usize, queries: usize, heads: usize) -> Self {
        let candidates = Self::candidates(limits, units, channels);
        let busy = |tile: &&Self| queries.div_ceil(tile.rows(units.shape)) * heads >= TILES;
        let tuned = Self::candidates(limits, units, Self::TUNED_CHANNELS);
        let measured = units.tiles.of(queries * heads * channels).and_then(|index| tuned.get(index));
        let mut ruled = candidates.iter().filter(|tile| !tile.is_experimental());
        // Wide heads do not fit every tile.
        let tile = measured.filter(|tile| candidates.contains(tile)).or(ruled.clone().find(busy));
        *tile.or(ruled.next_back()).expect("matrix units are used where a tile fits")
    }

    /// Whether it is used only after it was measured.
    pub(super) fn is_experimental(&self) -> bool {
        matches!(self, Self::Workgroup(_))
    }

    /// Channels of the heads that are measured: those of every DA3 network.
    pub(super) const TUNED_CHANNELS: usize = 64;

    /// Queries of a workgroup.
    pub fn rows(&self, shape: MatrixShape) -> usize {
        match self {
            Self::Subgroups(tile) => tile.rows(shape),
            Self::Workgroup(tile) => tile.rows as usize,
        }
    }
}

impl SubgroupQueries {
    /// A subgroup has 32 or 16 queries: every matrix of keys and values that is loaded is multiplied twice or once.
    fn candidates(limits: &Limits, shape: MatrixShape, channels: usize) -> impl Iterator<Item = Self> {
        let sides: &[u32] = if limits.cpu { &[8] } else { &[32, 16] };
        let tiles = sides.iter().flat_map(move |side| {
            let repeat = side.div_ceil(shape.m);
            // Every lane turns 8 scores of a row, or more, into 16 bytes of weights.
            let row_lanes = (limits.subgroup_size / (repeat * shape.m)).max(1);
            let keys = (2 * shape.n.max(shape.k)).max(8 * row_lanes);
            [4, 2, 1].map(|subgroups| Self { subgroups, repeat, keys })
        });
        tiles.filter(move |tile| tile.fits(limits, shape, channels))
    }

    /// Queries of a workgroup.
    pub(super) fn rows(&self, shape: MatrixShape) -> usize {
        (self.subgroups * self.repeat * shape.m) as usize
    }

    /// Queries of the largest workgroup.
    pub(super) fn most_rows(limits: &Limits, shape: MatrixShape) -> usize {
        Self::candidates(limits, shape, 8).map(|tile| tile.rows(shape)).max().unwrap_or(0)
    }

    /// Whether a workgroup is within the device's limits, its shared memory as kernels/ops/attention_matrix.comp lays it
    /// out.
    fn fits(&self, limits: &Limits, shape: MatrixShape, channels: usize) -> bool {
        let values = 2 * self.keys * (channels as u32 / 8 + 1);
        let scores = self.rows(shape) as u32 * (self.keys / 4 + 1);
        16 * (values + scores) <= limits.shared_bytes && self.subgroups * limits.subgroup_size <= limits.max_invocations
    }
}

impl WorkgroupQueries {
    /// Channels of the widest heads: beyond, sums leave no registers for all else.
    const MOST_CHANNELS: usize = 128;

    fn candidates(limits: &Limits, factor: Element, channels: usize) -> impl Iterator<Item = Self> {
        // Invocations; queries; keys.
        const SHAPES: [(u32, u32, u32); 5] =
            [(256, 128, 64), (256, 64, 64), (128, 128, 64), (128, 64, 64), (128, 64, 32)];
        let found = move |(invocations, rows, keys): (u32, u32, u32)| {
            let fits = |m: &&WorkgroupMatrices| {
                let MatrixShape { m: of_rows, n, k } = m.granularity;
                // Keys are columns of scores and terms of sums, channels the other way round.
                let sides = [(rows, of_rows), (keys, n), (keys, k), (n.max(k), n.min(k))];
                m.invocations == invocations && sides.iter().all(|(side, of)| side.is_multiple_of(*of))
            };
            let MatrixShape { n, k, .. } = limits.workgroup_matrices.iter().find(fits)?.granularity;
            Some(Self { subgroups: invocations / limits.subgroup_size, rows, keys, granularity: n.max(k) })
        };
        let can = factor == Element::F16 && channels <= Self::MOST_CHANNELS;
        SHAPES.into_iter().filter(move |_| can).filter_map(found)
    }
}

impl fmt::Display for AttentionTile {
    /// Subgroups, matrices or queries, keys.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Subgroups(SubgroupQueries { subgroups, repeat, keys }) => {
                write!(f, "{subgroups} of {repeat}, {keys} keys")
            }
            Self::Workgroup(WorkgroupQueries { subgroups, rows, keys, .. }) => {
                write!(f, "workgroup of {subgroups}, {rows} queries, {keys} keys")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{super::tile::Tiles, *};

    /// A device whose workgroups of so many invocations have matrices of sides that are multiples of these.
    fn with_workgroup_matrices(of: &[(u32, [u32; 3])]) -> Limits {
        let matrices = |&(invocations, [m, n, k]): &(u32, [u32; 3])| WorkgroupMatrices {
            invocations,
            granularity: MatrixShape { m, n, k },
        };
        Limits { workgroup_matrices: of.iter().map(matrices).collect(), ..Limits::default() }
    }

    fn units(factor: Element) -> Units {
        Units::of(factor, &Limits::default()).expect("an ordinary device has matrix units")
    }

    #[test]
    fn matrices_of_workgroups_come_behind_those_by_rule() {
        let ruled = AttentionTile::candidates(&Limits::default(), units(Element::F16), 64);
        assert!(!ruled.is_empty() && !ruled.iter().any(AttentionTile::is_experimental));
        let experimental = |limits: &Limits, factor: Element, channels: usize| -> Vec<WorkgroupQueries> {
            let tiles = AttentionTile::candidates(limits, units(factor), channels);
            assert_eq!(tiles[..ruled.len()], ruled);
            let of = |tile: &AttentionTile| match tile {
                AttentionTile::Workgroup(tile) => *tile,
                other => panic!("{other} among those by rule"),
            };
            tiles[ruled.len()..].iter().map(of).collect()
        };
        let tile = |subgroups, rows, keys, granularity| WorkgroupQueries { subgroups, rows, keys, granularity };
        let small = [tile(4, 128, 64, 16), tile(4, 64, 64, 16), tile(4, 64, 32, 16)];
        let both = with_workgroup_matrices(&[(128, [32, 16, 16]), (256, [32, 32, 16])]);
        for channels in [16, 64] {
            let found = experimental(&both, Element::F16, channels);
            assert_eq!(found[..2], [tile(8, 128, 64, 32), tile(8, 64, 64, 32)]);
            assert_eq!(found[2..], small);
        }
        assert_eq!(experimental(&both, Element::Bf16, 64), []);
        assert_eq!(experimental(&with_workgroup_matrices(&[(128, [32, 16, 16])]), Element::F16, 64), small);
        // Keys and queries that are no multiples.
        let coarse = with_workgroup_matrices(&[(128, [128, 16, 64])]);
        assert_eq!(experimental(&coarse, Element::F16, 64), [tile(4, 128, 64, 64)]);
        let odd = with_workgroup_matrices(&[(128, [16, 48, 16]), (256, [16, 16, 128]), (64, [16; 3])]);
        assert_eq!(experimental(&odd, Element::F16, 64), []);
        let wide = AttentionTile::candidates(&both, units(Element::F16), 160);
        assert!(!wide.iter().any(AttentionTile::is_experimental));
    }

    #[test]
    fn attention_on_matrices_of_workgroups_has_to_be_measured() {
        let limits = with_workgroup_matrices(&[(128, [32, 16, 16])]);
        let units = units(Element::F16);
        let tiles = AttentionTile::candidates(&limits, units, AttentionTile::TUNED_CHANNELS);
        for (queries, heads) in [(1, 1), (300, 16), (60_000, 24)] {
            assert!(!AttentionTile::choose(&limits, units, 64, queries, heads).is_experimental());
            for (index, tile) in tiles.iter().enumerate() {
                let units = Units { tiles: Tiles::always(index), ..units };
                let choose = |channels| AttentionTile::choose(&limits, units, channels, queries, heads);
                // Also for heads of other sizes, as far as it fits them.
                assert_eq!([16, 64].map(choose), [*tile; 2]);
                assert_eq!(choose(128).is_experimental(), tile.is_experimental());
                assert!(!choose(192).is_experimental());
            }
        }
    }
}
