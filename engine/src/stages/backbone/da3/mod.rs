//! The DA3 backbone: a vision transformer over all views.
//!
//! Source: ZipSplat, section 3.1; Depth Anything 3; DINOv2.

mod camera_encoder;
mod features;
mod positions;

pub use positions::{interpolate as interpolate_positions, rotary_tables};

use super::Backbone;
use crate::{
    Result,
    gpu::{Element, Recorder, Run, Tensor},
    kernels::backbone as kernels,
    ops::{Block, Heads, HostParameter, Linear, Norm, ParameterLayout, Parameters, Rows, Sequences},
    stages::{Architecture, ViewGrid, embed_patches},
    types::{Camera, prior_encoding},
};
use camera_encoder::{CameraEncoder, POSE_VALUES};
use features::Features;

/// Norms of the backbone's residual stream add this to the variance; all others add 1e-5.
const EPS: f32 = 1e-6;

/// The backbone's parameters.
pub struct Da3 {
    architecture: Architecture,
    class_token: Tensor,
    camera_tokens: Tensor,
    learned_positions: HostParameter,
    patch_embed: Linear,
    blocks: Vec<Block>,
    final_norm: Norm,
    camera_encoder: CameraEncoder,
    features: Features,
}

impl Da3 {
    /// Declares the parameters.
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        let root = "backbone.backbone";
        let heads = Heads::new(a.heads, a.width);
        Self {
            class_token: p.vector(&format!("{root}.cls_token"), &[1, 1, a.width]),
            camera_tokens: p.vector(&format!("{root}.camera_token"), &[1, 2, a.width]),
            learned_positions: p.host(&format!("{root}.pos_embed"), &[1, 1 + a.position_grid.pow(2), a.width]),
            patch_embed: p.convolution(&format!("{root}.patch_embed.proj"), &[3, a.patch, a.patch], a.width),
            blocks: (0..a.depth)
                .map(|i| {
                    let name = format!("{root}.blocks.{i}");
                    Block::new(p, &name, heads, i >= a.qk_norm_start, (a.ffn, a.ffn_hidden), EPS)
                })
                .collect(),
            final_norm: p.norm(&format!("{root}.norm"), a.width, EPS),
            camera_encoder: CameraEncoder::new(p, a),
            features: Features::new(p, a),
            architecture: a.clone(),
        }
    }

    fn first_tokens(&self, rec: &mut Recorder, images: Tensor, positions: Tensor, grid: ViewGrid) -> Rows {
        let width = self.architecture.width;
        let tokens = 1 + grid.patches();
        rec.scope("embed", |rec| {
            let patches = embed_patches(rec, images, grid, &self.patch_embed);
            let out = Rows::scratch(rec, "tokens", grid.views * tokens, width, Element::F32);
            let kernel = kernels::Tokens {
                patches: patches.tensor,
                class_token: self.class_token,
                positions,
                out: out.tensor,
                views: grid.views as u32,
                tokens: tokens as u32,
                width: width as u32,
            };
            rec.dispatch(kernel, out.values());
            rec.observe("bb/tokens0", out.tensor);
            out
        })
    }

    fn insert_camera_tokens(&self, rec: &mut Recorder, x: Tensor, encoded: Option<Tensor>, grid: ViewGrid) {
        let width = self.architecture.width;
        let kernel = kernels::CameraToken {
            camera_tokens: encoded.unwrap_or(self.camera_tokens),
            out: x,
            views: grid.views as u32,
            tokens: 1 + grid.patches() as u32,
            width: width as u32,
            encoded: encoded.is_some(),
        };
        rec.dispatch(kernel, grid.views * width);
    }
}

impl Backbone for Da3 {
    /// `[1 + patches, width]` f32: [`interpolate_positions`]; `[1 + patches, head / 2, 2]` f32: [`rotary_tables`], for local and for
    /// global blocks; and with cameras, without which the camera encoder does not run, `[views, POSE_VALUES]` f32.
    fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor> {
        let (a, tokens) = (&self.architecture, 1 + grid.patches());
        let positions = rec.input::<f32>("positions", tokens * a.width);
        let [local, global] =
            ["rotary_local", "rotary_global"].map(|name| rec.input::<f32>(name, tokens * a.head_dim()));
        let poses = cameras.then(|| rec.input::<[f32; POSE_VALUES]>("poses", grid.views));
        [positions, local, global].into_iter().chain(poses).collect()
    }

    fn record(&self, rec: &mut Recorder, images: Tensor, inputs: &[Tensor], grid: ViewGrid) -> Vec<Rows> {
        let (a, tokens) = (&self.architecture, 1 + grid.patches());
        let (positions, rotary, poses) = (inputs[0], [inputs[1], inputs[2]], inputs.get(3));
        let poses = poses.map(|poses| Rows::new(*poses, grid.views, POSE_VALUES));
        let camera_tokens = poses.map(|poses| self.camera_encoder.record(rec, poses));
        let x = self.first_tokens(rec, images, positions, grid);
        // The newest local block's output, where a global block has overwritten it.
        let mut local = x;
        let mut prepared = Vec::new();
        for (i, block) in self.blocks.iter().enumerate() {
            if i == a.alt_start {
                self.insert_camera_tokens(rec, x.tensor, camera_tokens, grid);
                rec.observe("bb/alt_in", x.tensor);
            }
            let global = a.is_global(i);
            let out_layer = a.out_layers.contains(&i);
            if global && out_layer {
                local = Rows::scratch(rec, "local", x.count, x.width, Element::F32);
                rec.copy(x.tensor, local.tensor);
            } else if !global {
                local = x;
            }
            let table = (rotary[global as usize], tokens);
            let sequences = Sequences {
                count: if global { 1 } else { grid.views },
                tokens: if global { grid.views * tokens } else { tokens },
                rotary: (i >= a.rope_start).then_some(table),
            };
            rec.scope("block", |rec| block.record(rec, x, sequences));
            rec.observe(&format!("bb/block{i}"), x.tensor);
            if out_layer {
                let feature = a.out_layers.len() - 1 - prepared.len();
                prepared.push(
                    rec.scope("features", |rec| self.features.record(rec, feature, local, x, self.final_norm, grid)),
                );
            }
        }
        prepared.reverse();
        prepared
    }

    fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        cameras: Option<&[Camera]>,
        parameters: &Parameters,
    ) -> Result<()> {
        let (a, learned) = (&self.architecture, &parameters[self.learned_positions]);
        let ViewGrid { rows, columns, .. } = grid;
        run.write(inputs[0], &interpolate_positions(learned, a.position_grid, a.width, rows, columns))?;
        for (tensor, table) in inputs[1..].iter().zip(rotary_tables(rows, columns, a.head_dim())) {
            run.write(*tensor, &table)?;
        }
        if let (Some(tensor), Some(cameras)) = (inputs.get(3), cameras) {
            let padded = |e: &[f32; 9]| std::array::from_fn(|i| e.get(i).copied().unwrap_or(0.0));
            let poses: Vec<[f32; POSE_VALUES]> = prior_encoding(cameras)?.iter().map(padded).collect();
            run.write(*tensor, &poses)?;
        }
        Ok(())
    }
}
