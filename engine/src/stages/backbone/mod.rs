//! Backbone: a DA3 vision transformer over all views, from pixels to one set of tokens for each out layer.
//!
//! Source: ZipSplat, section 3.1; Depth Anything 3; DINOv2.

mod camera_encoder;
mod features;
mod positions;

pub use camera_encoder::POSE_VALUES;
pub use positions::{interpolate as interpolate_positions, rotary_tables};

use super::{Architecture, ViewGrid, embed_patches};
use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::backbone as kernels,
    ops::{Block, Heads, HostParameter, Linear, Norm, ParameterLayout, Rows, Sequences},
};
use camera_encoder::CameraEncoder;
use features::Features;

/// Norms of the backbone's residual stream add this to the variance; all others add 1e-5.
const EPS: f32 = 1e-6;

/// The backbone's parameters.
pub struct Backbone {
    architecture: Architecture,
    class_token: Tensor,
    camera_tokens: Tensor,
    pub(crate) learned_positions: HostParameter,
    patch_embed: Linear,
    blocks: Vec<Block>,
    final_norm: Norm,
    camera_encoder: CameraEncoder,
    features: Features,
}

/// What the host hands over.
#[derive(Clone, Copy, Debug)]
pub struct BackboneInputs {
    /// `[views, 3, height, width]` f32, RGB in 0..1.
    pub images: Tensor,
    /// `[1 + patches, width]` f32: [`interpolate_positions`].
    pub positions: Tensor,
    /// `[2, 1 + patches, head / 2, 2]` f32: [`rotary_tables`], for local and for global blocks.
    pub rotary: [Tensor; 2],
    /// `[views, POSE_VALUES]` f32 where poses are given; without, the camera encoder does not run.
    pub poses: Option<Tensor>,
}

impl Backbone {
    /// Lays out the parameters.
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

    /// Records the backbone. Returns the prepared tokens of all views for each out layer, deepest first.
    pub fn record(&self, rec: &mut Recorder, inputs: BackboneInputs, grid: ViewGrid) -> Vec<Rows> {
        let a = &self.architecture;
        let tokens = 1 + grid.patches();
        let camera_tokens = inputs.poses.map(|poses| {
            let poses = Rows::new(poses, grid.views, POSE_VALUES);
            self.camera_encoder.record(rec, poses)
        });
        let x = self.first_tokens(rec, inputs, grid);
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
            let table = (inputs.rotary[global as usize], tokens);
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

    fn first_tokens(&self, rec: &mut Recorder, inputs: BackboneInputs, grid: ViewGrid) -> Rows {
        let width = self.architecture.width;
        let tokens = 1 + grid.patches();
        rec.scope("embed", |rec| {
            let patches = embed_patches(rec, inputs.images, grid, &self.patch_embed);
            let out = Rows::scratch(rec, "tokens", grid.views * tokens, width, Element::F32);
            let kernel = kernels::Tokens {
                patches: patches.tensor,
                class_token: self.class_token,
                positions: inputs.positions,
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
