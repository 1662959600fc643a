//! Values of any channels, lifted to Gaussians or tokens and drawn.

use super::{FrameInputs, backward::slot_starts};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{
        features::{Draw, Gather, Lift},
        limits::TILE,
    },
    ops::row_chunks,
};

/// Channels per vector.
pub(crate) const VECTOR: usize = 4;
/// Vectors that a pixel blends at once, in registers.
pub(crate) const VECTORS_AT_ONCE: usize = 4;
const GPU_PIXELS: u32 = 64;

#[derive(Clone, Copy)]
pub(crate) struct Lifting {
    /// `[cells y, cells x, vectors, 4]`.
    pub values: Tensor,
    pub cells: [u32; 2],
    pub vectors: usize,
    /// Consecutive Gaussians of a row.
    pub group: usize,
    /// `[rows, vectors, 4]`: accumulated sums of weighted values.
    pub lifted: Tensor,
    /// `[rows]`: accumulated weights.
    pub totals: Tensor,
}

impl FrameInputs<'_> {
    /// Lifts one camera's values and returns the status; exceeded capacity accumulates nothing.
    pub(crate) fn record_lift(self, rec: &mut Recorder, lifting: Lifting) -> Tensor {
        let Self { scene, shape, capacity, .. } = self;
        let Lifting { values, cells, vectors, group, lifted, totals: row_totals } = lifting;
        rec.scope("lift", |rec| {
            let (splats, lists) = self.intersect(rec);
            let slots = slot_starts(rec, &splats);
            let sums = rec.tensor::<[f32; VECTOR]>("sums", capacity * vectors);
            let totals = rec.tensor::<f32>("totals", capacity);
            let lanes = rec.limits().subgroup_size;
            let kernel = Lift {
                pair_indices: lists.pair_indices,
                tile_offsets: lists.tile_offsets,
                tile_sets: splats.tile_sets,
                slots,
                xy_opacities: splats.xy_opacities,
                conics: splats.conics,
                values,
                sums,
                totals,
                size: [shape.width, shape.height],
                grid: shape.grid(),
                cells,
                first_tile_row: 0,
                vectors: vectors as u32,
                capacity: capacity as u32,
                runs: TILE * TILE / lanes,
            };
            let [x, y] = shape.grid();
            let flops = 2 * (capacity * VECTOR * vectors) as u64 * u64::from(TILE * TILE);
            rec.dispatch_groups(kernel, [x, y, (vectors as u32).div_ceil(lanes)]).flops(flops);
            let rows = scene.len.div_ceil(group);
            let kernel = Gather {
                slots,
                status: lists.status,
                sums,
                totals,
                lifted,
                row_totals,
                gaussians: scene.len as u32,
                group: group as u32,
                rows: rows as u32,
                vectors: vectors as u32,
            };
            rec.dispatch(kernel, rows * vectors);
            rec.output(lists.status);
            lists.status
        })
    }

    /// Draws one camera's pictures, `[height, width, VECTORS_AT_ONCE, 4]` for each of `features`,
    /// `[rows, VECTORS_AT_ONCE, 4]`. Returns them and the status.
    pub(crate) fn record_pictures(
        self,
        rec: &mut Recorder,
        features: &[Tensor],
        group: usize,
    ) -> (Vec<Tensor>, Tensor) {
        let Self { shape, capacity, .. } = self;
        rec.scope("features", |rec| {
            let (splats, lists) = self.intersect(rec);
            let lanes = rec.limits().subgroup_size;
            let runs = if rec.limits().cpu { TILE * TILE / lanes } else { (GPU_PIXELS / lanes).max(1) };
            let [x, y] = shape.grid();
            let row = shape.width as usize * VECTORS_AT_ONCE;
            let band = TILE as usize * row * size_of::<[f32; VECTOR]>();
            let flops = 2 * (capacity * VECTOR * VECTORS_AT_ONCE) as u64 * u64::from(TILE * TILE);
            let draw = |features: &Tensor| {
                let pictures = rec.tensor::<[f32; VECTOR]>("pictures", shape.height as usize * row);
                for tile_rows in row_chunks(rec, y as usize, &[band]) {
                    let first = tile_rows.start * TILE as usize;
                    let rows = (tile_rows.end * TILE as usize).min(shape.height as usize) - first;
                    let kernel = Draw {
                        pair_indices: lists.pair_indices,
                        tile_offsets: lists.tile_offsets,
                        xy_opacities: splats.xy_opacities,
                        conics: splats.conics,
                        features: *features,
                        pictures: pictures.slice::<[f32; VECTOR]>(first * row, rows * row),
                        size: [shape.width, shape.height],
                        grid: [x, y],
                        first_tile_row: tile_rows.start as u32,
                        group: group as u32,
                        runs,
                        vectors: VECTORS_AT_ONCE as u32,
                    };
                    let groups = [x * (TILE * TILE / (lanes * runs)), tile_rows.len() as u32, 1];
                    rec.dispatch_groups(kernel, groups).flops(flops * tile_rows.len() as u64 / u64::from(y));
                }
                rec.output(pictures);
                pictures
            };
            let pictures = features.iter().map(draw).collect();
            rec.output(lists.status);
            (pictures, lists.status)
        })
    }
}
