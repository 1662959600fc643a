//! How matrix kernels cut their work into workgroups.

use crate::gpu::{Element, Limits, MatrixShape};

/// What a workgroup of ops/linear_matrix owns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinearTile {
    /// Subgroups along rows and columns.
    pub subgroups: [u32; 2],
    /// Matrices of a subgroup along rows and columns.
    pub repeats: [u32; 2],
    /// Terms of the sums that pass through shared memory at a time.
    pub k: u32,
}

/// Fewer tiles than this leave some of a large GPU's cores (132 on an H200, 144 on the largest others) without work.
const TILES: usize = 256;

impl LinearTile {
    /// Shapes to choose from, largest first: what a subgroup owns is 64 x 64, where every matrix that is loaded is
    /// multiplied four times, or 32 x 32.
    pub fn candidates(limits: &Limits, factor: Element, shape: MatrixShape) -> Vec<Self> {
        // On a CPU matrices are loops that take long to compile.
        let sides: &[u32] = if limits.cpu { &[16] } else { &[64, 32] };
        let tile = |side: &u32| LinearTile {
            subgroups: [2, 2],
            repeats: [side.div_ceil(shape.m), side.div_ceil(shape.n)],
            k: if limits.cpu { 2 * shape.k } else { shape.k.next_multiple_of(64 / factor.bytes() as u32) },
        };
        sides.iter().map(tile).filter(|tile| tile.fits(limits, factor, shape)).collect()
    }

    /// The largest tile that leaves enough of them to keep the device busy, else the smallest.
    ///
    /// # Panics
    /// Where none fits; [`LinearTile::candidates`] says so.
    pub(super) fn choose(limits: &Limits, factor: Element, shape: MatrixShape, rows: usize, columns: usize) -> Self {
        let candidates = Self::candidates(limits, factor, shape);
        let busy = |tile: &&Self| {
            let [tile_rows, tile_columns] = tile.sides(shape);
            rows.div_ceil(tile_rows) * columns.div_ceil(tile_columns) >= TILES
        };
        *candidates.iter().find(busy).or(candidates.last()).expect("matrix units are used where a tile fits")
    }

    /// Rows and columns of a workgroup.
    pub fn sides(&self, shape: MatrixShape) -> [usize; 2] {
        let side = |axis: usize, matrix: u32| (self.subgroups[axis] * self.repeats[axis] * matrix) as usize;
        [side(0, shape.m), side(1, shape.n)]
    }

    /// Whether a workgroup is within the device's limits, its shared memory as kernels/ops/linear_matrix.comp lays it out.
    fn fits(&self, limits: &Limits, factor: Element, shape: MatrixShape) -> bool {
        let subgroups = self.subgroups[0] * self.subgroups[1];
        let [rows, columns] = self.sides(shape);
        let piece = 8 * factor.bytes() as u32;
        let stages = 2 * (rows + columns) as u32 * (self.k / 8 + 1);
        let strips = subgroups * shape.m * (self.repeats[1] * shape.n * 4 / piece + 1);
        piece * stages.max(strips) <= limits.shared_bytes && subgroups * limits.subgroup_size <= limits.max_invocations
    }
}

/// What a workgroup of ops/attention_matrix owns.
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
    /// Shapes to choose from for heads of `channels`, largest first: a subgroup's 32 or 16 queries, where every matrix of
    /// keys and values that is loaded is multiplied twice or once.
    pub fn candidates(limits: &Limits, shape: MatrixShape, channels: usize) -> Vec<Self> {
        let sides: &[u32] = if limits.cpu { &[8] } else { &[32, 16] };
        let tiles = sides.iter().flat_map(|side| {
            let repeat = side.div_ceil(shape.m);
            // Every lane turns 8 scores of a row, or more, into 16 bytes of weights.
            let row_lanes = (limits.subgroup_size / (repeat * shape.m)).max(1);
            let keys = (2 * shape.n.max(shape.k)).max(8 * row_lanes);
            let tile = move |subgroups| AttentionTile { subgroups, repeat, keys };
            [tile(4), tile(2), tile(1)]
        });
        tiles.filter(|tile| tile.fits(limits, shape, channels)).collect()
    }

    /// The largest tile that leaves enough of them to keep the device busy, else the smallest.
    ///
    /// # Panics
    /// Where none fits; [`AttentionTile::candidates`] says so.
    pub(super) fn choose(limits: &Limits, shape: MatrixShape, channels: usize, queries: usize, heads: usize) -> Self {
        let candidates = Self::candidates(limits, shape, channels);
        let busy = |tile: &&Self| queries.div_ceil(tile.rows(shape)) * heads >= TILES;
        *candidates.iter().find(busy).or(candidates.last()).expect("matrix units are used where a tile fits")
    }

    /// Queries of a workgroup.
    pub fn rows(&self, shape: MatrixShape) -> usize {
        (self.subgroups * self.repeat * shape.m) as usize
    }

    /// Queries of the largest workgroup.
    pub(super) fn most_rows(limits: &Limits, shape: MatrixShape) -> usize {
        Self::candidates(limits, shape, 8).iter().map(|tile| tile.rows(shape)).max().unwrap_or(0)
    }

    /// Whether a workgroup is within the device's limits, its shared memory as kernels/ops/attention_matrix.comp lays it
    /// out.
    fn fits(&self, limits: &Limits, shape: MatrixShape, channels: usize) -> bool {
        let values = 2 * self.keys * (channels as u32 / 8 + 1);
        let scores = self.rows(shape) as u32 * (self.keys / 4 + 1);
        16 * (values + scores) <= limits.shared_bytes && self.subgroups * limits.subgroup_size <= limits.max_invocations
    }
}
