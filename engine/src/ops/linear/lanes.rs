//! Linear layers on lanes: the kernels, and how they cut their work into workgroups.

use super::{
    super::{
        rows::Rows,
        tile::{BUSY, Tiles},
        uniform::{UNIFORM_TILE, divides_panels, terms_of},
    },
    Epilogue, Linear, Weights,
};
use crate::{
    gpu::{Element, Limits, Recorder},
    kernels::{limits::LINEAR_ROWS, ops},
};
use std::fmt;

/// Lanes as a linear layer uses them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lanes {
    /// Type of the factors.
    pub element: Element,
    /// How work is cut for them; by rule for ops/linear.
    pub tiles: Tiles,
}

/// The share of a linear layer that a workgroup of lanes owns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LaneTile {
    /// Rows and columns of the workgroup.
    pub sides: [u32; 2],
    /// Rows and columns of a lane.
    pub lane: [u32; 2],
    /// Terms of the sums that pass through shared memory at a time; 0 where none do, in ops/linear and ops/linear_uniform.
    pub k: u32,
}

/// Sums of as many terms are cut into parts where they are few.
const LONG: usize = 2048;

impl Lanes {
    /// Factors of a type, by ops/linear.
    pub const fn of(element: Element) -> Self {
        Self { element, tiles: Tiles::BY_RULE }
    }
}

impl LaneTile {
    /// Candidates, that of the rule first.
    pub fn candidates(limits: &Limits, element: Element) -> Vec<Self> {
        const GPU: &[LaneTile] = &[
            LaneTile { sides: [128, 128], lane: [8, 8], k: 8 },
            LaneTile { sides: [128, 64], lane: [8, 8], k: 8 },
            LaneTile { sides: [64, 64], lane: [8, 8], k: 8 },
            LaneTile { sides: [64, 64], lane: [8, 4], k: 16 },
            LaneTile { sides: [64, 64], lane: [4, 4], k: 16 },
            LaneTile { sides: [32, 32], lane: [4, 4], k: 16 },
        ];
        // On a CPU larger ones take long to compile.
        const CPU: &[LaneTile] = &[LaneTile { sides: [8, 32], lane: [2, 4], k: 8 }];
        let ruled = match is_uniform(limits, [element, Element::F32]) {
            true => {
                let [rows, vectors] = UNIFORM_TILE;
                Self { sides: [rows, vectors * limits.subgroup_size], lane: UNIFORM_TILE, k: 0 }
            }
            false => Self { sides: [LINEAR_ROWS, 4 * limits.subgroup_size], lane: [LINEAR_ROWS, 4], k: 0 },
        };
        let staged = if limits.cpu { CPU } else { GPU }.iter().copied().filter(|tile| tile.fits(limits));
        [ruled].into_iter().chain(staged).collect()
    }

    /// Lanes of the workgroup.
    fn lanes(&self) -> u32 {
        self.sides.iter().product::<u32>() / self.lane.iter().product::<u32>()
    }

    /// True where a workgroup of whole subgroups and its shared memory, as kernels/ops/linear_tiled.comp lays it out, are within the
    /// device's limits.
    fn fits(&self, limits: &Limits) -> bool {
        let [rows, columns] = self.sides;
        let shared_bytes = 16 * (rows * (self.k / 4 + 1) + self.k * columns / 4);
        let lanes = self.lanes();
        lanes.is_multiple_of(limits.subgroup_size)
            && lanes <= limits.max_invocations
            && shared_bytes <= limits.shared_bytes
    }

    /// Workgroups along columns and rows.
    fn groups(&self, rows: usize, columns: usize) -> [usize; 2] {
        [columns.div_ceil(self.sides[1] as usize), rows.div_ceil(self.sides[0] as usize)]
    }

    /// Terms of the parts that sums of `inner` terms are cut into: all of them, unless they are many and fewer workgroups have them
    /// than half of a large GPU's cores, about [`BUSY`] / 2. Never by what was measured, so that results keep their bits. Sums of f32
    /// factors stay whole: those of `exact` have one order.
    fn share(&self, element: Element, inner: usize, workgroups: usize) -> usize {
        if element == Element::F32 || inner < LONG || workgroups > BUSY / 4 {
            return inner;
        }
        let parts = (BUSY / 2 / workgroups.max(1)).min(2 * inner / LONG);
        inner.div_ceil(parts).next_multiple_of(self.k as usize)
    }
}

impl fmt::Display for LaneTile {
    /// Sides, those of a lane, depth.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { sides: [rows, columns], lane: [lane_rows, lane_columns], k } = self;
        write!(f, "{rows}x{columns} of {lane_rows}x{lane_columns}")?;
        if *k > 0 { write!(f, ", k {k}") } else { Ok(()) }
    }
}

/// True where ops/linear_uniform takes the place of ops/linear, for inputs and results of these types.
fn is_uniform(limits: &Limits, types: [Element; 2]) -> bool {
    types == [Element::F32; 2] && divides_panels(limits)
}

impl Linear {
    /// Applies the layer on lanes.
    pub(super) fn on_lanes(&self, rec: &mut Recorder, lanes: Lanes, input: Rows, out: Rows, epilogue: Epilogue) {
        let candidates = LaneTile::candidates(rec.limits(), lanes.element);
        let chosen = lanes.tiles.of(input.count * self.columns).and_then(|index| candidates.get(index));
        match chosen.filter(|tile| tile.k > 0) {
            Some(tile) => self.tiled(rec, *tile, input, out, epilogue),
            None if is_uniform(rec.limits(), [input.element, out.element]) => self.uniform(rec, input, out, epilogue),
            None => self.panels(rec, input, out, epilogue),
        }
    }

    fn uniform(&self, rec: &mut Recorder, input: Rows, out: Rows, epilogue: Epilogue) {
        let (rows, [tile_rows, vectors]) = (input.count, UNIFORM_TILE);
        let tile_columns = vectors * rec.limits().subgroup_size;
        let [weight, integers, scales] = self.weights();
        let kernel = ops::LinearUniform {
            a: input.tensor,
            weight,
            bias: self.bias,
            gamma: epilogue.gamma.unwrap_or(self.bias),
            residual: epilogue.residual.map_or(self.bias, |residual| residual.tensor),
            out: out.tensor,
            integers,
            scales,
            rows: rows as u32,
            inner: self.inner as u32,
            columns: self.columns as u32,
            activation: epilogue.activation as u32,
            scale: epilogue.gamma.is_some(),
            add: epilogue.residual.is_some(),
            q8: self.kernel.weights() == Weights::Q8,
            terms: terms_of(self.inner),
            tile_rows,
            vectors,
        };
        let groups = [rows.div_ceil(tile_rows as usize), self.columns.div_ceil(tile_columns as usize), 1];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }

    fn panels(&self, rec: &mut Recorder, input: Rows, out: Rows, epilogue: Epilogue) {
        let (lanes, rows) = (rec.limits().subgroup_size as usize, input.count);
        let [weight, integers, scales] = self.weights();
        let kernel = ops::Linear {
            a: input.tensor,
            weight,
            bias: self.bias,
            gamma: epilogue.gamma.unwrap_or(self.bias),
            residual: epilogue.residual.map_or(self.bias, |residual| residual.tensor),
            out: out.tensor,
            integers,
            scales,
            rows: rows as u32,
            inner: self.inner as u32,
            columns: self.columns as u32,
            activation: epilogue.activation as u32,
            scale: epilogue.gamma.is_some(),
            add: epilogue.residual.is_some(),
            q8: self.kernel.weights() == Weights::Q8,
            input: input.element,
            output: out.element,
        };
        let groups = [rows.div_ceil(LINEAR_ROWS as usize), self.columns.div_ceil(4 * lanes), 1];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }

    fn tiled(&self, rec: &mut Recorder, tile: LaneTile, input: Rows, out: Rows, epilogue: Epilogue) {
        let workgroups = tile.groups(input.count, self.columns).iter().product();
        let share = tile.share(input.element, self.inner, workgroups);
        let parts = self.inner.div_ceil(share);
        if parts == 1 {
            return self.staged(rec, tile, input, out, epilogue, share);
        }
        let sums = Rows::scratch(rec, "sums", parts * input.count, self.columns, Element::F32);
        self.staged(rec, tile, input, sums, Epilogue::default(), share);
        let kernel = ops::LinearMerge {
            sums: sums.tensor,
            bias: self.bias,
            gamma: epilogue.gamma.unwrap_or(self.bias),
            residual: epilogue.residual.map_or(self.bias, |residual| residual.tensor),
            out: out.tensor,
            rows: input.count as u32,
            columns: self.columns as u32,
            parts: parts as u32,
            activation: epilogue.activation as u32,
            scale: epilogue.gamma.is_some(),
            add: epilogue.residual.is_some(),
            output: out.element,
        };
        rec.dispatch(kernel, input.count * self.columns.div_ceil(4));
    }

    /// Sums of `share` terms each, parts of them one behind the other, or all and their epilogue.
    fn staged(&self, rec: &mut Recorder, tile: LaneTile, input: Rows, out: Rows, epilogue: Epilogue, share: usize) {
        let [weight, integers, scales] = self.weights();
        let (rows, parts) = (input.count, self.inner.div_ceil(share));
        let kernel = ops::LinearTiled {
            a: input.tensor,
            weight,
            bias: self.bias,
            gamma: epilogue.gamma.unwrap_or(self.bias),
            residual: epilogue.residual.map_or(self.bias, |residual| residual.tensor),
            out: out.tensor,
            integers,
            scales,
            rows: rows as u32,
            inner: self.inner as u32,
            columns: self.columns as u32,
            share: share as u32,
            activation: epilogue.activation as u32,
            scale: epilogue.gamma.is_some(),
            add: epilogue.residual.is_some(),
            q8: self.kernel.weights() == Weights::Q8,
            subgroups: tile.lanes() / rec.limits().subgroup_size,
            tile_columns: tile.sides[1],
            lane_rows: tile.lane[0],
            lane_columns: tile.lane[1],
            tile_k: tile.k,
            split: parts > 1,
            input: input.element,
            output: out.element,
        };
        // Columns run fastest: workgroups that run at once share their rows, and all of the weight stays in the cache.
        let [along_columns, along_rows] = tile.groups(rows, self.columns);
        let groups = [along_columns, along_rows, parts];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }
}
