use super::Units;
use crate::gpu::{Element, Limits};
use std::fmt;

/// Tile selection by result size, in [`Tiles::CLASSES`] classes from 2^14 values by factors of
/// four.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tiles([Option<u8>; Tiles::CLASSES]);

impl Tiles {
    pub const CLASSES: usize = 7;

    pub const BY_RULE: Self = Self([None; Self::CLASSES]);

    pub fn always(index: usize) -> Self {
        Self([Some(index as u8); Self::CLASSES])
    }

    pub(crate) fn set_from(&mut self, class: usize, index: usize) {
        self.0[class..].fill(Some(index as u8));
    }

    pub(crate) fn values(class: usize) -> usize {
        1 << (14 + 2 * class)
    }

    pub(super) fn of(&self, values: usize) -> Option<usize> {
        let class = values.max(1).ilog2().saturating_sub(13) as usize / 2;
        self.0[class.min(Self::CLASSES - 1)].map(usize::from)
    }
}

/// Splits long 16-bit sums with few tiles, by shape alone: tuning never changes bits.
pub(super) fn split_k(factor: Element, inner: usize, rows: usize, columns: usize) -> usize {
    const LONG: usize = 2048;
    let workgroups = (rows.div_ceil(64) * columns.div_ceil(64)).max(1);
    if !Element::HALVES.contains(&factor) || inner < LONG || workgroups > BUSY / 4 {
        return inner;
    }
    let parts = (BUSY / 2 / workgroups).min(2 * inner / LONG);
    inner.div_ceil(parts).next_multiple_of(128)
}

/// Work of one workgroup in a matrix kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Subgroups by rows, columns.
    pub subgroups: [u32; 2],
    /// Matrices per subgroup by rows, columns.
    pub repeats: [u32; 2],
    /// Terms, or keys, per shared memory stage.
    pub k: u32,
}

type Layout = ([u32; 2], [u32; 2]);

const BUSY: usize = 256;

/// Returns the measured candidate, else the first of `by_rule` defaults that fills the device, else
/// the last default.
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
    /// Head channels in attention tuning, as in every DA3 network.
    pub const TUNED_CHANNELS: usize = 64;
    /// Widest heads of attention on matrix units: 16 queries stay in registers.
    pub const MOST_CHANNELS: usize = 2 * Self::TUNED_CHANNELS;

    /// Candidates: three defaults on GPUs, larger first.
    pub fn linear(limits: &Limits, units: Units) -> Vec<Self> {
        // With bytes per shared memory row.
        const GPU: &[(Layout, u32)] = &[
            (([4, 2], [48, 64]), 128),
            (([2, 4], [64, 32]), 128),
            (([2, 2], [32, 32]), 128),
            (([2, 2], [64, 64]), 64),
        ];
        // CPUs emulate matrices by loops that compile slowly.
        const CPU: &[(Layout, u32)] = &[(([2, 2], [8, 8]), 16), (([1, 1], [16, 16]), 16)];
        let (shape, factor_bytes) = (units.shape, units.factor.bytes() as u32);
        let tile = |&(layout, bytes): &(Layout, u32)| {
            let k = if limits.cpu { 2 * shape.k } else { shape.k.next_multiple_of(bytes / factor_bytes) };
            Self::of(layout, units, k)
        };
        // Mirrors kernels/ops/linear_matrix.comp.
        let shared_bytes = |tile: &Self| {
            let [rows, columns] = tile.sides(units);
            let stage = (rows + columns) as u32 * (tile.k * factor_bytes + 16);
            stage.max(tile.all_subgroups() * shape.m * (tile.repeats[1] * shape.n * 4 + 16))
        };
        let tiles = if limits.cpu { CPU } else { GPU }.iter().map(tile);
        tiles.filter(|tile| tile.fits(limits, shared_bytes(tile))).collect()
    }

    /// Candidates, 32-query defaults first, larger first.
    pub fn attention(limits: &Limits, units: Units, channels: usize) -> Vec<Self> {
        // Queries of a subgroup, subgroups, keys.
        const GPU: &[[u32; 3]] = &[[32, 4, 64], [32, 2, 64], [32, 4, 32], [32, 1, 32], [16, 4, 64], [16, 1, 32]];
        const CPU: &[[u32; 3]] = &[[8, 4, 8], [8, 1, 8], [16, 2, 16]];
        let Units { factor, shape, .. } = units;
        let tile = |&[queries, subgroups, keys]: &[u32; 3]| Self {
            subgroups: [subgroups, 1],
            repeats: [queries.div_ceil(shape.m), 1],
            k: keys.next_multiple_of(shape.n.max(shape.k)),
        };
        // Queries stay in registers.
        let holds = |&&[queries, ..]: &&[u32; 3]| queries as usize * channels <= 32 * Self::TUNED_CHANNELS;
        let tiles = if limits.cpu { CPU } else { GPU }.iter().filter(holds).map(tile);
        // Mirrors kernels/shared/attention_matrix.glsl.
        let shared_bytes = |tile: &Self| {
            let (channels, rows) = (channels as u32, tile.repeats[0] * shape.m);
            let (staged, weights) = (2 * tile.k * (channels / 8 + 1), rows * (tile.k / 8 + 1));
            let scratch = match factor {
                Element::F16 => weights.max(shape.m * (channels / 4 + 1)),
                _ => weights + shape.m * (channels.max(shape.n).max(shape.k) / 4 + 1),
            };
            16 * (staged + tile.subgroups[0] * scratch) + 4 * tile.k
        };
        tiles.filter(|tile| tile.fits(limits, shared_bytes(tile))).collect()
    }

    /// Candidates, larger first.
    pub fn nearest(limits: &Limits, units: Units) -> Vec<Self> {
        const GPU: &[Layout] = &[([2, 4], [64, 32]), ([2, 2], [64, 32]), ([2, 2], [32, 32])];
        const CPU: &[Layout] = &[([2, 2], [16, 8]), ([2, 2], [8, 8])];
        let shape = units.shape;
        // Mirrors kernels/cluster/nearest_matrix.comp.
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

    pub fn sides(&self, units: Units) -> [usize; 2] {
        let matrix = [units.shape.m, units.shape.n];
        [0, 1].map(|axis| (self.subgroups[axis] * self.repeats[axis] * matrix[axis]) as usize)
    }

    pub(super) fn all_subgroups(&self) -> u32 {
        self.subgroups[0] * self.subgroups[1]
    }

    fn fits(&self, limits: &Limits, shared_bytes: u32) -> bool {
        shared_bytes <= limits.shared_bytes && self.all_subgroups() * limits.subgroup_size <= limits.max_invocations
    }
}

impl fmt::Display for Tile {
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
            assert_eq!(tiles.of(Tiles::values(class) / 4), (class == 0).then_some(1));
        }
    }
}
