//! How matrix kernels cut their work into workgroups, and which candidate a kernel takes.

use super::Units;
use crate::gpu::{Element, Limits};
use std::fmt;

/// The candidate that a kernel takes, by the number of values of its result: [`Tiles::CLASSES`] sizes from 2^14 on, four times
/// apart. The default takes candidates by rule; `tune` measures them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tiles([Option<u8>; Tiles::CLASSES]);

impl Tiles {
    /// Sizes that are told apart.
    pub const CLASSES: usize = 7;

    /// Candidates by rule, whatever the size.
    pub const BY_RULE: Self = Self([None; Self::CLASSES]);

    /// The candidate at an index, whatever the size.
    pub fn always(index: usize) -> Self {
        Self([Some(index as u8); Self::CLASSES])
    }

    /// Takes the candidate at an index for one class of sizes and those above.
    pub(crate) fn set_from(&mut self, class: usize, index: usize) {
        self.0[class..].fill(Some(index as u8));
    }

    /// Values of a result in the middle of a class.
    pub(crate) fn values(class: usize) -> usize {
        1 << (14 + 2 * class)
    }

    /// The candidate for a result of `values`, where one was chosen.
    pub(super) fn of(&self, values: usize) -> Option<usize> {
        let class = values.max(1).ilog2().saturating_sub(13) as usize / 2;
        self.0[class.min(Self::CLASSES - 1)].map(usize::from)
    }
}

/// Terms of the parts that a linear layer's sums of `inner` terms are cut into: all, unless they are many and 64 x 64 of the results
/// give work to less than half of a large GPU's cores. A matter of the layer's shape alone, so that results keep their bits whatever
/// was measured. Only those of 16-bit factors: sums of `exact` are added up term by term, and sums of integers are exact.
pub(super) fn share(factor: Element, inner: usize, rows: usize, columns: usize) -> usize {
    const LONG: usize = 2048;
    let workgroups = (rows.div_ceil(64) * columns.div_ceil(64)).max(1);
    if !Element::HALVES.contains(&factor) || inner < LONG || workgroups > BUSY / 4 {
        return inner;
    }
    let parts = (BUSY / 2 / workgroups).min(2 * inner / LONG);
    // Every kernel's depth divides them.
    inner.div_ceil(parts).next_multiple_of(128)
}

/// The share of a matrix kernel's work that a workgroup owns. Rows and columns are those of a linear layer; or points and
/// targets, of which the nearest are sought; or an attention's queries, each with all channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Subgroups along rows and columns.
    pub subgroups: [u32; 2],
    /// Matrices of a subgroup along rows and columns.
    pub repeats: [u32; 2],
    /// Terms of the sums, or keys of an attention, that pass through shared memory at a time.
    pub k: u32,
}

/// Subgroups along rows and columns, and rows and columns of each.
type Layout = ([u32; 2], [u32; 2]);

/// Fewer tiles than this leave some of a large GPU's cores (132 on an H200, 144 on the largest others) without work.
const BUSY: usize = 256;

/// The candidate that was measured to be fastest; else of those `by_rule`, which come first, the first that leaves enough
/// workgroups to keep the device busy, else the last.
///
/// # Panics
/// A list without a candidate: kernels with tiles are used where one fits.
pub(super) fn choose<T: Copy>(
    candidates: &[T],
    measured: Option<usize>,
    by_rule: usize,
    workgroups: impl Fn(&T) -> usize,
) -> T {
    let ruled = &candidates[..by_rule.min(candidates.len())];
    let busy = ruled.iter().find(|tile| workgroups(tile) >= BUSY);
    let measured = measured.and_then(|index| candidates.get(index));
    *measured.or(busy).or(ruled.last()).expect("kernels with tiles are used where one fits")
}

impl Tile {
    /// Channels of the heads that attention's tiles are measured with: those of every DA3 network.
    pub const TUNED_CHANNELS: usize = 64;

    /// Candidates of ops/linear_matrix, the first two by rule, the larger first: what a subgroup owns is 64 x 64, where every
    /// matrix that is loaded is multiplied four times, or 32 x 32.
    pub fn linear(limits: &Limits, units: Units) -> Vec<Self> {
        // With the bytes of a row that pass through shared memory.
        const GPU: &[(Layout, u32)] = &[
            (([2, 2], [64, 64]), 64),
            (([2, 2], [32, 32]), 64),
            (([2, 2], [32, 32]), 128),
            (([2, 2], [64, 32]), 64),
            (([4, 2], [32, 64]), 64),
            (([2, 4], [64, 32]), 64),
        ];
        // On a CPU matrices are loops that take long to compile.
        const CPU: &[(Layout, u32)] = &[(([2, 2], [16, 16]), 16), (([1, 1], [16, 16]), 16)];
        let (shape, factor_bytes) = (units.shape, units.factor.bytes() as u32);
        let tile = |&(layout, bytes): &(Layout, u32)| {
            let k = if limits.cpu { 2 * shape.k } else { shape.k.next_multiple_of(bytes / factor_bytes) };
            Self::of(layout, units, k)
        };
        // As kernels/ops/linear_matrix.comp lays shared memory out.
        let shared_bytes = |tile: &Self| {
            let [rows, columns] = tile.sides(units);
            let stages = 2 * (rows + columns) as u32 * (tile.k * factor_bytes + 16);
            stages.max(tile.all_subgroups() * shape.m * (tile.repeats[1] * shape.n * 4 + 16))
        };
        let tiles = if limits.cpu { CPU } else { GPU }.iter().map(tile);
        tiles.filter(|tile| tile.fits(limits, shared_bytes(tile))).collect()
    }

    /// Candidates of ops/attention_matrix for heads of `channels`, those by rule first, the larger first. A subgroup has 16 or 32
    /// queries: every matrix of keys and values that is loaded is multiplied once or twice. Once is the rule, since twice leaves
    /// an H100 too few registers and takes 1.6 times as long there.
    pub fn attention(limits: &Limits, units: Units, channels: usize) -> Vec<Self> {
        let shape = units.shape;
        let queries: &[u32] = if limits.cpu { &[8] } else { &[16, 32] };
        let tiles = queries.iter().flat_map(|queries| {
            let repeat = queries.div_ceil(shape.m);
            // Every lane turns 8 scores of a row, or more, into 16 bytes of weights.
            let row_lanes = (limits.subgroup_size / (repeat * shape.m)).max(1);
            let k = (2 * shape.n.max(shape.k)).max(8 * row_lanes);
            [4, 2, 1].map(|subgroups| Self { subgroups: [subgroups, 1], repeats: [repeat, 1], k })
        });
        // As kernels/ops/attention_matrix.comp lays shared memory out.
        let shared_bytes = |tile: &Self| {
            let values = 2 * tile.k * (channels as u32 / 8 + 1);
            16 * (values + tile.sides(units)[0] as u32 * (tile.k / 4 + 1))
        };
        tiles.filter(|tile| tile.fits(limits, shared_bytes(tile))).collect()
    }

    /// Candidates of cluster/nearest_matrix, the larger first. A subgroup has two sets of sums, and so half as many as in a linear
    /// layer.
    pub fn nearest(limits: &Limits, units: Units) -> Vec<Self> {
        const GPU: &[Layout] = &[([2, 4], [64, 32]), ([2, 2], [64, 32]), ([2, 2], [32, 32])];
        const CPU: &[Layout] = &[([2, 2], [16, 8])];
        let shape = units.shape;
        // As kernels/cluster/nearest_matrix.comp lays shared memory out.
        let shared_bytes = |tile: &Self| {
            let [points, targets] = tile.sides(units).map(|side| side as u32);
            let stages = 2 * (points + targets) * (2 * tile.k / 8 + 1);
            let strips = tile.all_subgroups() * shape.m * (tile.repeats[1] * shape.n / 4 + 1);
            let ends = points * tile.subgroups[1] * (limits.subgroup_size / shape.m).max(1);
            16 * stages.max(strips).max(ends)
        };
        let layouts = if limits.cpu { CPU } else { GPU };
        let tiles = layouts.iter().map(|layout| Self::of(*layout, units, shape.k.next_multiple_of(16)));
        tiles.filter(|tile| tile.fits(limits, shared_bytes(tile))).collect()
    }

    fn of((subgroups, [rows, columns]): Layout, units: Units, k: u32) -> Self {
        Self { subgroups, repeats: [rows.div_ceil(units.shape.m), columns.div_ceil(units.shape.n)], k }
    }

    /// Rows and columns of a workgroup.
    pub fn sides(&self, units: Units) -> [usize; 2] {
        let matrix = [units.shape.m, units.shape.n];
        [0, 1].map(|axis| (self.subgroups[axis] * self.repeats[axis] * matrix[axis]) as usize)
    }

    /// Subgroups of a workgroup.
    pub(super) fn all_subgroups(&self) -> u32 {
        self.subgroups[0] * self.subgroups[1]
    }

    /// True where a workgroup with so much shared memory is within the device's limits.
    fn fits(&self, limits: &Limits, shared_bytes: u32) -> bool {
        shared_bytes <= limits.shared_bytes && self.all_subgroups() * limits.subgroup_size <= limits.max_invocations
    }
}

impl fmt::Display for Tile {
    /// Subgroups, matrices of each, depth.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { subgroups: [rows, columns], repeats: [m, n], k } = self;
        write!(f, "{rows}x{columns} of {m}x{n}, k {k}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_are_four_times_apart() {
        let mut tiles = Tiles::default();
        assert_eq!(tiles.of(0), None);
        tiles.set_from(0, 3);
        tiles.set_from(2, 5);
        let found = |values| tiles.of(values).expect("set from the smallest on");
        assert_eq!([0, 1, 1 << 14, 1 << 16, 1 << 17, 1 << 18, 1 << 30].map(found), [3, 3, 3, 3, 5, 5, 5]);
    }

    #[test]
    fn a_size_that_is_measured_lies_in_its_class() {
        for class in 0..Tiles::CLASSES {
            let mut tiles = Tiles::default();
            tiles.set_from(class, 1);
            assert_eq!(tiles.of(Tiles::values(class)), Some(1));
            // The smallest class has all that is smaller, too.
            assert_eq!(tiles.of(Tiles::values(class) / 4), (class == 0).then_some(1));
        }
    }
}
