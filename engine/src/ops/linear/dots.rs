use super::{
    super::{
        rows::Rows,
        tile::{Tiles, choose},
    },
    Epilogue, LaneTile, Linear,
};
use crate::{
    gpu::{Element, Limits, Recorder},
    kernels::ops,
};

const BY_RULE: usize = 2;

impl Linear {
    pub(super) fn dots(&self, rec: &mut Recorder, tiles: Tiles, input: Rows, out: Rows, epilogue: Epilogue) {
        let tile = self.dot_tile(rec.limits(), tiles, input.count);
        let (a, row_scales, column_scales) = self.quantized(rec, input);
        let rows = input.count;
        let kernel = linear_kernel!(LinearDot, self, a, out, epilogue, {
            weight: self.weight.slice::<i8>(0, self.columns * self.inner),
            row_scales,
            column_scales,
            subgroups: tile.lanes() / rec.limits().subgroup_size,
            tile_columns: tile.sides[1],
            lane_rows: tile.lane[0],
            lane_columns: tile.lane[1],
            tile_k: tile.k,
            factor: Element::I8,
            output: out.element,
        });
        let [tile_rows, tile_columns] = tile.sides.map(|side| side as usize);
        let groups = [self.columns.div_ceil(tile_columns), rows.div_ceil(tile_rows), 1];
        rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(rows));
    }

    fn dot_tile(&self, limits: &Limits, tiles: Tiles, rows: usize) -> LaneTile {
        let workgroups =
            |tile: &LaneTile| rows.div_ceil(tile.sides[0] as usize) * self.columns.div_ceil(tile.sides[1] as usize);
        choose(&LaneTile::candidates(limits, Element::I8), tiles.of(rows * self.columns), BY_RULE, workgroups)
    }
}
