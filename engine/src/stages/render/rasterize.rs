use super::{Depth, FrameShape, RenderOptions, intersect::TileLists, project::Splats};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{limits::TILE, render::Rasterize},
};
use std::ops::Range;

/// Rows between cuts, which align parts to 256 bytes.
const BAND: usize = 64;
/// Small images have few tiles; CPU workgroups take whole tiles.
const GPU_PIXELS: u32 = 64;
const BLEND_FLOPS: u64 = 24;

/// Splits one picture, with `row` values a row, at the binding limit. Callers split batches.
pub(super) fn bands(rec: &Recorder, shape: FrameShape, row: usize) -> impl Iterator<Item = Range<usize>> + use<> {
    let height = shape.height as usize;
    let rows_at_once = (rec.limits().max_binding_bytes as usize / (4 * row) / BAND * BAND).max(BAND);
    let rows = if shape.cameras == 1 { rows_at_once.min(height) } else { height };
    (0..height).step_by(rows).map(move |first| first..height.min(first + rows))
}

pub(super) fn record(
    rec: &mut Recorder,
    splats: &Splats,
    lists: &TileLists,
    shape: FrameShape,
    options: &RenderOptions,
) -> Tensor {
    let row = shape.width as usize * options.channels();
    let frames = rec.tensor::<f32>("frames", shape.cameras * shape.height as usize * row);
    let lanes = rec.limits().subgroup_size;
    let runs = if rec.limits().cpu { TILE * TILE / lanes } else { (GPU_PIXELS / lanes).max(1) };
    let groups_a_tile = TILE * TILE / (lanes * runs);
    let blends = lists.pair_indices.bytes() / 4 * u64::from(TILE * TILE);
    for band in bands(rec, shape, row) {
        let (first, rows) = (band.start, band.len());
        let kernel = Rasterize {
            pair_indices: lists.pair_indices,
            tile_offsets: lists.tile_offsets,
            xy_opacities: splats.xy_opacities,
            conics: splats.conics,
            // Placeholders, if unused.
            colors: splats.colors.unwrap_or(splats.conics),
            depths: options.depth.map_or(splats.conics, |_| splats.depths),
            normals: splats.normals.unwrap_or(splats.conics),
            frames: frames.slice::<f32>(first * row, shape.cameras * rows * row),
            size: [shape.width, shape.height],
            grid: shape.grid(),
            first_tile_row: first as u32 / TILE,
            row_count: rows as u32,
            background: options.background,
            runs,
            color: options.rgb,
            has_background: options.background != [0.0; 3],
            alpha: options.alpha,
            depth: options.depth.is_some(),
            expected_depth: options.depth == Some(Depth::Expected),
            normal: options.normals,
            token_pairs: options.token_group.map_or(0, |group| group.get().saturating_mul(shape.cameras as u32)),
            batched: !rec.limits().cpu,
        };
        let groups = [shape.grid()[0] * groups_a_tile, (rows as u32).div_ceil(TILE), shape.cameras as u32];
        rec.dispatch_groups(kernel, groups).flops(blends * BLEND_FLOPS * rows as u64 / u64::from(shape.height));
    }
    frames
}
