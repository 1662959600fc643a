use super::{
    super::{
        rows::Rows,
        tile::Tiles,
        uniform::{UNIFORM_TILE, divides_panels, terms_of},
    },
    Epilogue, Linear,
};
use crate::{
    gpu::{Element, Limits, Recorder},
    kernels::{limits::LINEAR_ROWS, ops},
};
use std::fmt;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lanes {
    pub element: Element,
    pub tiles: Tiles,
}

/// Tile of a linear layer on lanes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneTile {
    /// Workgroup rows and columns.
    pub sides: [u32; 2],
    /// Lane rows and columns.
    pub lane: [u32; 2],
    /// Terms per shared memory stage; 0 without staging.
    pub k: u32,
}

impl Lanes {
    /// Default tiles for a factor type.
    pub const fn of(element: Element) -> Self {
        Self { element, tiles: Tiles::BY_RULE }
    }
}

impl LaneTile {
    /// Candidates, defaults first.
    pub fn candidates(limits: &Limits, element: Element) -> Vec<Self> {
        if element == Element::I8 {
            return Self::of_dots(limits);
        }
        const GPU: &[LaneTile] = &[
            LaneTile { sides: [128, 128], lane: [8, 8], k: 8 },
            LaneTile { sides: [128, 64], lane: [8, 8], k: 8 },
            LaneTile { sides: [64, 64], lane: [8, 8], k: 8 },
            LaneTile { sides: [64, 64], lane: [8, 4], k: 16 },
            LaneTile { sides: [64, 64], lane: [4, 4], k: 16 },
            LaneTile { sides: [32, 32], lane: [4, 4], k: 16 },
        ];
        // Larger tiles compile slowly on CPUs.
        const CPU: &[LaneTile] = &[LaneTile { sides: [8, 32], lane: [2, 4], k: 8 }];
        let ruled = if is_uniform(limits, [element, Element::F32]) {
            let [rows, vectors] = UNIFORM_TILE;
            Self { sides: [rows, vectors * limits.subgroup_size], lane: UNIFORM_TILE, k: 0 }
        } else {
            Self { sides: [LINEAR_ROWS, 4 * limits.subgroup_size], lane: [LINEAR_ROWS, 4], k: 0 }
        };
        let staged = if limits.cpu { CPU } else { GPU }.iter().copied();
        [ruled].into_iter().chain(staged.filter(|tile| tile.fits(limits, tile.shared_bytes()))).collect()
    }

    fn of_dots(limits: &Limits) -> Vec<Self> {
        const GPU: &[LaneTile] = &[
            LaneTile { sides: [64, 64], lane: [8, 4], k: 32 },
            LaneTile { sides: [32, 32], lane: [4, 4], k: 64 },
            LaneTile { sides: [128, 128], lane: [8, 8], k: 32 },
            LaneTile { sides: [128, 64], lane: [8, 8], k: 32 },
            LaneTile { sides: [64, 64], lane: [4, 4], k: 64 },
        ];
        let columns = 4 * limits.subgroup_size;
        let cpu = [
            LaneTile { sides: [16, columns], lane: [4, 4], k: 32 },
            LaneTile { sides: [8, 2 * columns], lane: [2, 4], k: 64 },
        ];
        // Mirrors kernels/ops/linear_dot.comp.
        let shared_bytes = |tile: &Self| 8 * tile.sides.iter().sum::<u32>() * (tile.k / 8 + 1);
        let tiles = if limits.cpu { &cpu } else { GPU }.iter().copied();
        tiles.filter(|tile| tile.fits(limits, shared_bytes(tile))).collect()
    }

    pub(super) fn lanes(&self) -> u32 {
        self.sides.iter().product::<u32>() / self.lane.iter().product::<u32>()
    }

    /// Mirrors kernels/ops/linear_tiled.comp.
    fn shared_bytes(&self) -> u32 {
        let [rows, columns] = self.sides;
        16 * (rows * (self.k / 4 + 1) + self.k * columns / 4)
    }

    fn fits(&self, limits: &Limits, shared_bytes: u32) -> bool {
        let lanes = self.lanes();
        lanes.is_multiple_of(limits.subgroup_size)
            && lanes <= limits.max_invocations
            && shared_bytes <= limits.shared_bytes
    }
}

impl fmt::Display for LaneTile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sides: [rows, columns], lane: [lane_rows, lane_columns], k } = self;
        write!(f, "{rows}x{columns} of {lane_rows}x{lane_columns}")?;
        if *k > 0 { write!(f, ", k {k}") } else { Ok(()) }
    }
}

fn is_uniform(limits: &Limits, types: [Element; 2]) -> bool {
    types == [Element::F32; 2] && divides_panels(limits)
}

impl Linear {
    pub(super) fn on_lanes(
        &self,
        rec: &mut Recorder,
        lanes: Lanes,
        input: Rows,
        out: Rows,
        epilogue: Epilogue,
        split_k: usize,
    ) {
        let candidates = LaneTile::candidates(rec.limits(), lanes.element);
        let chosen = lanes.tiles.of(input.count * self.columns).and_then(|index| candidates.get(index));
        match chosen.filter(|tile| tile.k > 0) {
            Some(tile) => self.tiled(rec, *tile, input, out, epilogue, split_k),
            None if is_uniform(rec.limits(), [input.element, out.element]) => self.uniform(rec, input, out, epilogue),
            None => self.panels(rec, input, out, epilogue, split_k),
        }
    }

    fn uniform(&self, rec: &mut Recorder, input: Rows, out: Rows, epilogue: Epilogue) {
        let (rows, [tile_rows, vectors]) = (input.count, UNIFORM_TILE);
        let tile_columns = vectors * rec.limits().subgroup_size;
        let kernel = linear_kernel!(weights LinearUniform, self, input, out, epilogue, {
            terms: terms_of(self.inner),
            tile_rows,
            vectors,
        });
        let groups = [rows.div_ceil(tile_rows as usize), self.columns.div_ceil(tile_columns as usize), 1];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }

    fn panels(&self, rec: &mut Recorder, input: Rows, out: Rows, epilogue: Epilogue, split_k: usize) {
        let (lanes, rows) = (rec.limits().subgroup_size as usize, input.count);
        let kernel = linear_kernel!(weights Linear, self, input, out, epilogue, {
            share: split_k as u32,
            split: split_k < self.inner,
            input: input.element,
            output: out.element,
        });
        let parts = self.inner.div_ceil(split_k);
        let groups = [rows.div_ceil(LINEAR_ROWS as usize), self.columns.div_ceil(4 * lanes), parts];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }

    fn tiled(&self, rec: &mut Recorder, tile: LaneTile, input: Rows, out: Rows, epilogue: Epilogue, split_k: usize) {
        let rows = input.count;
        let kernel = linear_kernel!(weights LinearTiled, self, input, out, epilogue, {
            share: split_k as u32,
            subgroups: tile.lanes() / rec.limits().subgroup_size,
            tile_columns: tile.sides[1],
            lane_rows: tile.lane[0],
            lane_columns: tile.lane[1],
            tile_k: tile.k,
            split: split_k < self.inner,
            input: input.element,
            output: out.element,
        });
        let [tile_rows, tile_columns] = tile.sides.map(|side| side as usize);
        let groups = [self.columns.div_ceil(tile_columns), rows.div_ceil(tile_rows), self.inner.div_ceil(split_k)];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }
}
