//! Depth Anything 3: a class token that becomes a camera token, global patches without positions.

mod camera_encoder;

use super::{
    positions::{interpolate, rotary_tables},
    transformer::{SpecialTokens, Transformer, place_tokens},
};
use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    kernels::backbone as kernels,
    ops::{Block, Heads, HostParameter, Linear, ParameterLayout, Parameters, Rotary, Rows},
    stages::{BackboneArchitecture, POSE_ENCODING, POSE_VALUES, Reference, ViewGrid, embed_patches},
    types::resample::cubic,
};
use camera_encoder::CameraEncoder;

const EPS: f32 = 1e-6;

struct CameraTokens {
    architecture: BackboneArchitecture,
    class_token: Tensor,
    /// `[2, width]` f32.
    camera_tokens: Option<Tensor>,
    learned_positions: HostParameter,
    patch_embed: Linear,
    encoder: Option<CameraEncoder>,
}

pub(super) fn transformer(p: &mut ParameterLayout, a: &BackboneArchitecture) -> Transformer {
    let (root, width) = (&a.root, a.width);
    let class_token = p.vector(&format!("{root}.cls_token"), &[1, 1, width]);
    let camera_tokens = a.alternates().then(|| p.vector(&format!("{root}.camera_token"), &[1, 2, width]));
    let learned_positions = p.host(&format!("{root}.pos_embed"), &[1, 1 + a.position_grid.pow(2), width]);
    let patch_embed = p.convolution(&format!("{root}.patch_embed.proj"), &[3, a.patch_size, a.patch_size], width);
    let block = |i| {
        let (name, heads) = (format!("{root}.blocks.{i}"), Heads::new(a.heads, width));
        Block::new(p, &name, heads, i >= a.qk_norm_start, a.ffn, a.ffn_hidden, EPS)
    };
    let blocks = (0..a.depth).map(block).collect();
    let final_norm = Some(p.norm(&format!("{root}.norm"), width, a.final_eps));
    let encoder = a.camera.as_ref().map(|camera| CameraEncoder::new(p, camera, width));
    let architecture = a.clone();
    let special = CameraTokens { architecture, class_token, camera_tokens, learned_positions, patch_embed, encoder };
    Transformer { architecture: a.clone(), blocks, final_norm, special: Box::new(special) }
}

struct Inputs<'a> {
    positions: Tensor,
    /// Local, global.
    rotary: &'a [Tensor],
    poses: Option<Tensor>,
}

impl CameraTokens {
    fn named<'a>(&self, inputs: &'a [Tensor]) -> Inputs<'a> {
        let (positions, rest) = (inputs[0], &inputs[1..]);
        let (rotary, poses) = rest.split_at(if self.architecture.rotates() { 2 } else { 0 });
        Inputs { positions, rotary, poses: poses.first().copied().filter(|_| self.encoder.is_some()) }
    }
}

impl SpecialTokens for CameraTokens {
    fn leading(&self) -> usize {
        1
    }

    /// Positions ([`interpolate_positions`]), tables ([`rotary_tables`]) and poses `[views,
    /// POSE_VALUES]`, f32.
    fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor> {
        let (a, tokens) = (&self.architecture, 1 + grid.patches());
        let mut inputs = vec![rec.input::<f32>("positions", tokens * a.width)];
        if a.rotates() {
            let tables = [("rotary_local", tokens), ("rotary_global", 1)];
            inputs.extend(tables.map(|(name, turned)| rec.input::<f32>(name, turned * a.head_dim())));
        }
        inputs.extend(cameras.then(|| rec.input::<[f32; POSE_VALUES]>("poses", grid.views)));
        inputs
    }

    fn first(&self, rec: &mut Recorder, images: Tensor, inputs: &[Tensor], grid: ViewGrid) -> Rows {
        rec.scope("embed", |rec| {
            let patches = embed_patches(rec, images, grid, &self.patch_embed, false);
            place_tokens(rec, patches, self.class_token, 1, [1, 0], Some(self.named(inputs).positions), grid)
        })
    }

    fn choose(&self, rec: &mut Recorder, x: Rows, inputs: &[Tensor], grid: ViewGrid) -> Option<Tensor> {
        if self.named(inputs).poses.is_some() {
            return None;
        }
        let reference = rec.tensor::<u32>("reference", 1);
        let kernel = kernels::ReferenceView {
            tokens: x.tensor,
            direction: rec.tensor::<f32>("direction", x.width),
            scores: rec.tensor::<[f32; 4]>("scores", grid.views),
            reference,
            views: grid.views as u32,
            tokens_per_view: 1 + grid.patches() as u32,
            width: x.width as u32,
        };
        rec.dispatch_groups(kernel, 1u32);
        rec.observe("bb/ref_metrics", kernel.scores);
        rec.observe("bb/ref_idx", reference);
        Some(reference)
    }

    fn joined(
        &self,
        rec: &mut Recorder,
        x: Rows,
        inputs: &[Tensor],
        reference: Reference,
        chosen: Option<Tensor>,
        grid: ViewGrid,
    ) -> Rows {
        let poses = self.named(inputs).poses.map(|poses| Rows::new(poses, grid.views, POSE_VALUES));
        let encoded = poses.zip(self.encoder.as_ref()).map(|(poses, encoder)| encoder.record(rec, poses));
        let learned = self.camera_tokens.expect("views are joint");
        let kernel = kernels::CameraToken {
            camera_tokens: encoded.unwrap_or(learned),
            chosen: chosen.unwrap_or(learned),
            out: x.tensor,
            views: grid.views as u32,
            tokens: 1 + grid.patches() as u32,
            width: x.width as u32,
            reference: if let Reference::View(view) = reference { view as u32 } else { 0 },
            encoded: encoded.is_some(),
            on_device: chosen.is_some(),
        };
        rec.dispatch(kernel, grid.views * x.width);
        x
    }

    fn rotary(&self, inputs: &[Tensor], grid: ViewGrid, global: bool) -> Rotary {
        let tokens = 1 + grid.patches();
        let table = self.named(inputs).rotary[usize::from(global)];
        Rotary { table, tokens, turned: if global { 1 } else { tokens } }
    }

    fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        poses: Option<&[[f32; POSE_ENCODING]]>,
        parameters: &Parameters,
    ) -> Result<()> {
        let (a, learned) = (&self.architecture, &parameters[self.learned_positions]);
        let ViewGrid { rows, columns, .. } = grid;
        let inputs = self.named(inputs);
        run.write(inputs.positions, &interpolate_positions(learned, a.position_grid, a.width, rows, columns))?;
        for (tensor, table) in inputs.rotary.iter().zip(rotary_tables(rows, columns, a.head_dim())) {
            run.write(*tensor, &table)?;
        }
        if let (Some(tensor), Some(poses)) = (inputs.poses, poses) {
            let padded = |e: &[f32; POSE_ENCODING]| std::array::from_fn(|i| e.get(i).copied().unwrap_or(0.0));
            run.write(tensor, &poses.iter().map(padded).collect::<Vec<[f32; POSE_VALUES]>>())?;
        }
        Ok(())
    }
}

/// Bicubic parameter of the reference.
const A: f64 = -0.75;

const OFFSET: f64 = 0.1;

/// Interpolates learned positions `[1 + side * side, width]` to `[1 + rows * columns, width]`,
/// bicubic with repeated edges.
pub fn interpolate_positions(learned: &[f32], side: usize, width: usize, rows: usize, columns: usize) -> Vec<f32> {
    interpolate(learned, [side, width], [rows, columns], taps)
}

fn taps(side: usize, count: usize) -> Vec<Vec<(usize, f64)>> {
    let scale = (count as f64 + OFFSET) / side as f64;
    let one = |i: usize| {
        let source = (i as f64 + 0.5) / scale - 0.5;
        let t = source - source.floor();
        let weights = [t + 1.0, t, 1.0 - t, 2.0 - t].map(|x| cubic(x, A));
        let index = |k: usize| (source.floor() as i64 - 1 + k as i64).clamp(0, side as i64 - 1) as usize;
        [0, 1, 2, 3].map(|k| (index(k), weights[k])).into()
    };
    (0..count).map(one).collect()
}
