//! Every Gaussian-tile intersection has a slot, written once. Gaussians sum consecutive slots in
//! order, without atomics.

use super::{Depth, FrameInputs, RenderOutputs, SceneTensors, intersect::TileLists, project::Splats, rasterize::bands};
use crate::{
    gpu::{Recorder, Tensor},
    kernels::{
        limits::TILE,
        render::{CamerasBackward, ColorBackward, ProjectBackward, RasterizeBackward, TileCounts},
    },
    ops::scan::exclusive_scan,
};

/// Tensors to accumulate gradients in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gradients {
    pub scene: Option<SceneTensors>,
    /// `[cameras, 10]` f32: w x, y, z, v x, y, z for the update pose o (exp(w^), v) of
    /// camera-to-world; fx, fy, cx, cy.
    pub cameras: Option<Tensor>,
}

pub const CAMERA_NUMBERS: usize = 10;
pub(super) const PAIR_NUMBERS: usize = 10;
const PART: usize = 128;
const FLOPS: u64 = 60;

/// Per Gaussian-camera pair.
#[derive(Clone, Copy)]
pub struct SplatGradients {
    /// `[pairs, 3]` f32; undefined if culled.
    pub conics: Tensor,
    /// `[pairs, 10]` f32; 0 if culled.
    pub d_pairs: Tensor,
}

impl SplatGradients {
    /// Gradients of projected centers, in pixels.
    pub(super) fn means2d(conics: &[[f32; 3]], d_pairs: &[[f32; PAIR_NUMBERS]]) -> Vec<[f32; 2]> {
        let gradient = |([a, k, p], [_, e, y, ..]): (&[f32; 3], &[f32; PAIR_NUMBERS])| {
            let along = a * e;
            if *e == 0.0 && *y == 0.0 { [0.0; 2] } else { [along, p * y - k * along] }
        };
        conics.iter().zip(d_pairs).map(gradient).collect()
    }
}

impl FrameInputs<'_> {
    /// Records rendering, `loss` (frames `[cameras, height, width, channels]` to gradients) and the
    /// backward pass. Exceeded capacity accumulates nothing.
    ///
    /// # Panics
    /// If the options have outputs without gradients: normals, token colors, expected depth without
    /// alpha.
    pub fn record_with_gradients(
        self,
        rec: &mut Recorder,
        loss: impl FnOnce(&mut Recorder, Tensor) -> Tensor,
        gradients: &Gradients,
    ) -> (RenderOutputs, SplatGradients) {
        let options = self.options;
        assert!(!options.normals && options.token_group.is_none(), "normals and token colors have no gradient");
        assert!(options.alpha || options.depth != Some(Depth::Expected), "the gradient of expected depth takes alpha");
        let (splats, lists, frames) = rec.scope("render", |rec| {
            let drawn = self.draw(rec);
            rec.output(drawn.1.status);
            drawn
        });
        let d_frames = loss(rec, frames);
        assert_eq!(d_frames.bytes(), frames.bytes(), "gradients of frames");
        let d_pairs = rec.scope("render_backward", |rec| {
            let backward = Backward { inputs: self, splats: &splats, lists: &lists };
            let slots = backward.rasterize(rec, frames, d_frames);
            backward.splats(rec, &slots, gradients)
        });
        (RenderOutputs { frames, status: lists.status }, SplatGradients { conics: splats.conics, d_pairs })
    }
}

struct Backward<'a> {
    inputs: FrameInputs<'a>,
    splats: &'a Splats,
    lists: &'a TileLists,
}

struct Slots {
    /// `[pairs + 1]`.
    starts: Tensor,
    /// `[capacity, 6]`.
    moments: Tensor,
    /// `[capacity, values]`.
    d_values: Tensor,
}

/// Returns the first slot of each pair, `[pairs + 1]`.
pub(super) fn slot_starts(rec: &mut Recorder, splats: &Splats) -> Tensor {
    let starts = rec.tensor::<u32>("slots", splats.pairs + 1);
    let (tile_sets, indices, pairs) = (splats.tile_sets, splats.indices, splats.pairs as u32);
    rec.dispatch(TileCounts { tile_sets, indices, tile_counts: starts, pairs }, splats.pairs + 1);
    exclusive_scan(rec, starts, splats.pairs + 1);
    starts
}

impl Backward<'_> {
    fn rasterize(&self, rec: &mut Recorder, frames: Tensor, d_frames: Tensor) -> Slots {
        let &Backward { inputs: FrameInputs { shape, options, capacity, .. }, splats, lists } = self;
        let (tile_sets, starts) = (splats.tile_sets, slot_starts(rec, splats));
        let values = 3 * usize::from(options.rgb) + usize::from(options.depth.is_some());
        let moments = rec.tensor::<[f32; 6]>("moments", capacity);
        let d_values = rec.tensor::<f32>("d_values", capacity * values.max(1));
        let row = shape.width as usize * options.channels();
        let runs = TILE * TILE / rec.limits().subgroup_size;
        let blends = capacity as u64 * u64::from(TILE * TILE);
        for band in bands(rec, shape, row) {
            let (first, rows) = (band.start, band.len());
            let band = |frames: Tensor| frames.slice::<f32>(first * row, shape.cameras * rows * row);
            let kernel = RasterizeBackward {
                pair_indices: lists.pair_indices,
                tile_offsets: lists.tile_offsets,
                tile_sets,
                slots: starts,
                xy_opacities: splats.xy_opacities,
                conics: splats.conics,
                // Placeholders, if unused.
                colors: splats.colors.unwrap_or(splats.conics),
                depths: splats.depths,
                frames: band(frames),
                d_frames: band(d_frames),
                moments,
                d_values,
                size: [shape.width, shape.height],
                grid: shape.grid(),
                first_tile_row: first as u32 / TILE,
                row_count: rows as u32,
                capacity: capacity as u32,
                runs,
                color: options.rgb,
                alpha: options.alpha,
                depth: options.depth.is_some(),
                expected_depth: options.depth == Some(Depth::Expected),
                batched: !rec.limits().cpu,
            };
            let groups = [shape.grid()[0], (rows as u32).div_ceil(TILE), shape.cameras as u32];
            rec.dispatch_groups(kernel, groups).flops(blends * FLOPS * rows as u64 / u64::from(shape.height));
        }
        Slots { starts, moments, d_values }
    }

    fn splats(&self, rec: &mut Recorder, slots: &Slots, gradients: &Gradients) -> Tensor {
        let &Backward { inputs: FrameInputs { scene, cameras, shape, options, .. }, splats, lists } = self;
        let lanes = rec.limits().subgroup_size as usize;
        let d_pairs = rec.tensor::<[f32; PAIR_NUMBERS]>("d_pairs", splats.pairs.max(1));
        let parts = gradients.cameras.map(|_| {
            rec.tensor::<[f32; CAMERA_NUMBERS]>("d_camera_parts", scene.len.div_ceil(lanes).max(1) * shape.cameras)
        });
        let sh_bytes = 4 * SceneTensors::widths(scene.sh_degree)[4];
        let largest = sh_bytes.max(16).max(4 * PAIR_NUMBERS * shape.cameras);
        let part = (rec.limits().max_binding_bytes as usize / largest / PART * PART).max(PART);
        for first in (0..scene.len).step_by(part) {
            let len = part.min(scene.len - first);
            let pair = |tensor: Tensor, words: usize| {
                tensor.slice::<u32>(words * shape.cameras * first, words * shape.cameras * len)
            };
            let [means, scales, quats, opacities, sh_coeffs] = scene.part(first..first + len).all();
            let d = gradients.scene.map(|d| d.part(first..first + len).all());
            let [d_means, d_scales, d_quats, d_opacities, d_sh_coeffs] = d.unwrap_or([d_pairs; 5]);
            let kernel = ColorBackward {
                means,
                sh_coeffs,
                cameras,
                colors: splats.colors.map_or(d_pairs, |colors| pair(colors, 3)),
                status: lists.status,
                slots: slots.starts.slice::<u32>(first * shape.cameras, len * shape.cameras + 1),
                moments: slots.moments,
                d_values: slots.d_values,
                d_pairs: pair(d_pairs, PAIR_NUMBERS),
                d_sh_coeffs,
                gaussians: len as u32,
                camera_count: shape.cameras as u32,
                color: options.rgb,
                depth: options.depth.is_some(),
                sh_degree: scene.sh_degree,
                scene_gradients: gradients.scene.is_some(),
            };
            rec.dispatch(kernel, len);
            let kernel = ProjectBackward {
                means,
                scales,
                quats,
                opacities,
                cameras,
                conics: pair(splats.conics, 3),
                d_pairs: pair(d_pairs, PAIR_NUMBERS),
                d_means,
                d_scales,
                d_quats,
                d_opacities,
                d_cameras: parts.unwrap_or(d_means),
                gaussians: len as u32,
                first_group: (first / lanes) as u32,
                camera_count: shape.cameras as u32,
                width: shape.width,
                height: shape.height,
                antialiased: options.is_antialiased(),
                scene_gradients: gradients.scene.is_some(),
                camera_gradients: gradients.cameras.is_some(),
            };
            rec.dispatch(kernel, len);
        }
        if let (Some(d_cameras), Some(parts)) = (gradients.cameras, parts) {
            let numbers = shape.cameras * CAMERA_NUMBERS;
            let rows = scene.len.div_ceil(lanes) as u32;
            rec.dispatch_groups(CamerasBackward { parts, d_cameras, rows, numbers: numbers as u32 }, numbers);
        }
        d_pairs
    }
}
