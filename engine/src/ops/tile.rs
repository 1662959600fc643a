//! How matrix kernels cut their work into workgroups.

use super::{Units, nearest::SHARES};
use crate::gpu::{Limits, MatrixShape};
use std::fmt;

/// Which of its candidates a kernel takes, by the number of values of its result: [`Tiles::CLASSES`] sizes from 2^14 on,
/// four times apart. The default takes them by rule; [`Tuning`](super::Tuning) measures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tiles([Option<u8>; Tiles::CLASSES]);

impl Tiles {
    /// Sizes that are told apart.
    pub const CLASSES: usize = 7;

    /// The candidate at an index, whatever the size.
    pub fn always(index: usize) -> Self {
        Self([Some(index as u8); Self::CLASSES])
    }

    /// The candidate at an index for one class of sizes and those above.
    pub(super) fn set_from(&mut self, class: usize, index: usize) {
        self.0[class..].fill(Some(index as u8));
    }

    /// Values of a result in the middle of a class.
    pub(super) fn values(class: usize) -> usize {
        1 << (14 + 2 * class)
    }

    /// The candidate for a result of `values`, where one was chosen.
    pub(super) fn of(&self, values: usize) -> Option<usize> {
        let class = values.max(1).ilog2().saturating_sub(13) as usize / 2;
        self.0[class.min(Self::CLASSES - 1)].map(usize::from)
    }
}

/// The share of a linear layer that a workgroup of ops/linear_matrix owns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LinearTile(pub(super) SubgroupTile);

/// The matrices that the subgroups of a workgroup own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SubgroupTile {
    /// Subgroups along rows and columns.
    pub subgroups: [u32; 2],
    /// Matrices of a subgroup along rows and columns.
    pub repeats: [u32; 2],
    /// Terms of the sums that pass through shared memory at a time.
    pub k: u32,
}

/// Fewer tiles than this leave some of a large GPU's cores (132 on an H200, 144 on the largest others) without work.
pub(super) const TILES: usize = 256;

impl LinearTile {
    /// Shapes to choose from, the first two by rule, the larger first: what a subgroup owns is 64 x 64, where every matrix
    /// that is loaded is multiplied four times, or 32 x 32.
    pub fn candidates(limits: &Limits, units: Units) -> Vec<Self> {
        SubgroupTile::candidates(limits, units).map(Self).collect()
    }

    /// The tile that was measured to be fastest; by rule the larger of the first two if it leaves enough of them to keep the
    /// device busy.
    ///
    /// # Panics
    /// Where none fits; [`LinearTile::candidates`] says so.
    pub(super) fn choose(limits: &Limits, units: Units, rows: usize, columns: usize) -> Self {
        let candidates = Self::candidates(limits, units);
        let busy = |tile: &&Self| {
            let [tile_rows, tile_columns] = tile.sides(units.shape);
            limits.cpu || rows.div_ceil(tile_rows) * columns.div_ceil(tile_columns) >= TILES
        };
        let measured = units.tiles.of(rows * columns).and_then(|index| candidates.get(index));
        let ruled = &candidates[..candidates.len().min(2)];
        let tile = measured.or(ruled.iter().find(busy)).or(ruled.last());
        *tile.expect("matrix units are used where a tile fits")
    }

    /// Rows and columns of a workgroup.
    pub fn sides(&self, shape: MatrixShape) -> [usize; 2] {
        self.0.sides(shape)
    }
}

impl SubgroupTile {
    fn candidates(limits: &Limits, units: Units) -> impl Iterator<Item = Self> {
        let (shape, factor_bytes, cpu) = (units.shape, units.factor.bytes() as u32, limits.cpu);
        // Subgroups along rows and columns; rows and columns of each; bytes of a row that pass through shared memory.
        const GPU: &[([u32; 2], [u32; 2], u32)] = &[
            ([2, 2], [64, 64], 64),
            ([2, 2], [32, 32], 64),
            ([2, 2], [32, 32], 128),
            ([2, 2], [64, 32], 64),
            ([4, 2], [32, 64], 64),
            ([2, 4], [64, 32], 64),
        ];
        // There matrices are loops that take long to compile.
        const CPU: &[([u32; 2], [u32; 2], u32)] = &[([2, 2], [16, 16], 16), ([1, 1], [16, 16], 16)];
        let tile = move |&(subgroups, [rows, columns], bytes): &([u32; 2], [u32; 2], u32)| Self {
            subgroups,
            repeats: [rows.div_ceil(shape.m), columns.div_ceil(shape.n)],
            k: if cpu { 2 * shape.k } else { shape.k.next_multiple_of(bytes / factor_bytes) },
        };
        let layouts = if cpu { CPU } else { GPU };
        layouts.iter().map(tile).filter(move |tile| tile.fits(limits, units))
    }

    fn sides(&self, shape: MatrixShape) -> [usize; 2] {
        let side = |axis: usize, matrix: u32| (self.subgroups[axis] * self.repeats[axis] * matrix) as usize;
        [side(0, shape.m), side(1, shape.n)]
    }

    /// Whether a workgroup is within the device's limits, its shared memory as kernels/ops/linear_matrix.comp lays it out.
    fn fits(&self, limits: &Limits, units: Units) -> bool {
        let subgroups = self.subgroups[0] * self.subgroups[1];
        let [rows, columns] = self.sides(units.shape);
        let stages = 2 * (rows + columns) as u32 * (self.k * units.factor.bytes() as u32 + 16);
        let strips = subgroups * units.shape.m * (self.repeats[1] * units.shape.n * 4 + 16);
        stages.max(strips) <= limits.shared_bytes && subgroups * limits.subgroup_size <= limits.max_invocations
    }
}

/// What a workgroup of cluster/nearest_matrix owns: points are rows, targets columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NearestTile(pub(super) SubgroupTile);

impl NearestTile {
    /// Shapes to choose from, the larger first. A subgroup has two sets of sums, and so half as many as in a linear layer.
    pub fn candidates(limits: &Limits, units: Units) -> Vec<Self> {
        // Subgroups along points and targets; points and targets of each.
        const GPU: &[([u32; 2], [u32; 2])] = &[([2, 4], [64, 32]), ([2, 2], [64, 32]), ([2, 2], [32, 32])];
        const CPU: &[([u32; 2], [u32; 2])] = &[([2, 2], [16, 8])];
        let shape = units.shape;
        let tile = |&(subgroups, [points, targets]): &([u32; 2], [u32; 2])| SubgroupTile {
            subgroups,
            repeats: [points.div_ceil(shape.m), targets.div_ceil(shape.n)],
            k: shape.k.next_multiple_of(16),
        };
        let layouts = if limits.cpu { CPU } else { GPU };
        layouts.iter().map(tile).map(Self).filter(|tile| tile.fits(limits, shape)).collect()
    }

    /// The one asked for; by rule the largest that leaves enough workgroups to keep the device busy, else the smallest.
    ///
    /// # Panics
    /// Where none fits; [`NearestTile::candidates`] says so.
    pub(super) fn choose(limits: &Limits, units: Units, points: usize, targets: usize) -> Self {
        let candidates = Self::candidates(limits, units);
        let busy = |tile: &&Self| {
            let [tile_points, tile_targets] = tile.sides(units.shape);
            points.div_ceil(tile_points) * targets.div_ceil(tile_targets).min(SHARES) >= TILES
        };
        let given = units.tiles.of(points * targets).and_then(|index| candidates.get(index));
        let tile = given.or(candidates.iter().find(busy)).or(candidates.last());
        *tile.expect("matrix units are used where a tile fits")
    }

    /// Points and targets of a workgroup.
    pub fn sides(&self, shape: MatrixShape) -> [usize; 2] {
        self.0.sides(shape)
    }

    /// Whether a workgroup is within the device's limits, its shared memory as kernels/cluster/nearest_matrix.comp lays it
    /// out.
    fn fits(&self, limits: &Limits, shape: MatrixShape) -> bool {
        let SubgroupTile { subgroups: [along_points, along_targets], repeats: [m, n], k } = self.0;
        let subgroups = along_points * along_targets;
        let [points, targets] = self.sides(shape).map(|side| side as u32);
        let stages = 2 * (points + targets) * (2 * k / 8 + 1);
        let strips = subgroups * shape.m * (n * shape.n / 4 + 1);
        let ends = along_points * m * shape.m * along_targets * (limits.subgroup_size / shape.m).max(1);
        16 * stages.max(strips).max(ends) <= limits.shared_bytes
            && subgroups * limits.subgroup_size <= limits.max_invocations
    }
}

impl fmt::Display for SubgroupTile {
    /// Subgroups, matrices of each, depth.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { subgroups: [rows, columns], repeats: [m, n], k } = self;
        write!(f, "{rows}x{columns} of {m}x{n}, k {k}")
    }
}

impl fmt::Display for NearestTile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Display for LinearTile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
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
