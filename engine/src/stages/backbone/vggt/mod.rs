//! VGGT: DINOv2 with registers, then pairs of blocks within and across views.

use super::{
    positions::{Taps, interpolate, rotary_table},
    transformer::{SpecialTokens, Transformer, place_tokens},
};
use crate::{
    Result,
    gpu::{Element, Recorder, Run, Tensor},
    ops::{Block, Heads, HostParameter, Linear, Norm, ParameterLayout, Parameters, Rotary, Rows},
    stages::{BackboneArchitecture, POSE_ENCODING, Reference, ViewGrid, embed_patches},
    types::resample::cubic,
};

const REGISTERS: usize = 4;
const LEADING: usize = 1 + REGISTERS;

/// Of DINOv2's norms.
const EMBEDDING_EPS: f32 = 1e-6;
const EPS: f32 = 1e-5;

struct Registers {
    architecture: BackboneArchitecture,
    /// Class token and registers of DINOv2.
    embedding: [HostParameter; 2],
    /// Camera tokens and registers of the reference view and others.
    joint: [HostParameter; 2],
    learned_positions: HostParameter,
    patch_embed: Linear,
    norm: Norm,
}

pub(super) fn transformer(p: &mut ParameterLayout, a: &BackboneArchitecture) -> Transformer {
    let (root, width) = (&a.root, a.width);
    let embedding = format!("{root}.patch_embed");
    let mut token = |name: &str, shape: &[usize]| p.host(name, shape);
    let special = Registers {
        architecture: a.clone(),
        joint: [
            token(&format!("{root}.camera_token"), &[1, 2, 1, width]),
            token(&format!("{root}.register_token"), &[1, 2, REGISTERS, width]),
        ],
        embedding: [
            token(&format!("{embedding}.cls_token"), &[1, 1, width]),
            token(&format!("{embedding}.register_tokens"), &[1, REGISTERS, width]),
        ],
        learned_positions: token(&format!("{embedding}.pos_embed"), &[1, 1 + a.position_grid.pow(2), width]),
        patch_embed: p.convolution(&format!("{embedding}.patch_embed.proj"), &[3, a.patch_size, a.patch_size], width),
        norm: p.norm(&format!("{embedding}.norm"), width, EMBEDDING_EPS),
    };
    let block = |i: usize| {
        let (name, eps) = match i.checked_sub(a.alt_start) {
            None => (format!("{embedding}.blocks.{i}"), EMBEDDING_EPS),
            Some(i) => (format!("{root}.{}_blocks.{}", ["frame", "global"][i % 2], i / 2), EPS),
        };
        let heads = Heads::new(a.heads, width);
        Block::new(p, &name, heads, i >= a.qk_norm_start, a.ffn, a.ffn_hidden, eps)
    };
    let blocks = (0..a.depth).map(block).collect();
    Transformer { architecture: a.clone(), blocks, final_norm: None, special: Box::new(special) }
}

struct Inputs {
    /// `[leading + patches, width]`.
    positions: Tensor,
    /// `[leading, width]`.
    embedding: Tensor,
    /// `[2, leading, width]`.
    joint: Tensor,
    rotary: Tensor,
}

impl Inputs {
    fn of(inputs: &[Tensor]) -> Self {
        let [positions, embedding, joint, rotary] = inputs.try_into().expect("four inputs");
        Self { positions, embedding, joint, rotary }
    }
}

impl SpecialTokens for Registers {
    fn leading(&self) -> usize {
        LEADING
    }

    fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, _: bool) -> Vec<Tensor> {
        let (a, tokens) = (&self.architecture, LEADING + grid.patches());
        let sizes = [
            ("positions", tokens * a.width),
            ("special", LEADING * a.width),
            ("joint", 2 * LEADING * a.width),
            ("rotary", tokens * a.head_dim()),
        ];
        sizes.map(|(name, values)| rec.input::<f32>(name, values)).into()
    }

    fn first(&self, rec: &mut Recorder, images: Tensor, inputs: &[Tensor], grid: ViewGrid) -> Rows {
        let Inputs { positions, embedding, .. } = Inputs::of(inputs);
        rec.scope("embed", |rec| {
            let patches = embed_patches(rec, images, grid, &self.patch_embed, true);
            place_tokens(rec, patches, embedding, LEADING, [1, 0], Some(positions), grid)
        })
    }

    /// The order of views without their own token does not matter.
    fn joined(
        &self,
        rec: &mut Recorder,
        x: Rows,
        inputs: &[Tensor],
        reference: Reference,
        _: Option<Tensor>,
        grid: ViewGrid,
    ) -> Rows {
        let patches = Rows::scratch(rec, "embedded", grid.tokens(), x.width, Element::F32);
        self.norm.record(rec, x, None, patches, [LEADING, grid.patches()]);
        rec.observe("bb/embedded", patches.tensor);
        let reference = if let Reference::View(view) = reference { view } else { 0 };
        place_tokens(rec, patches, Inputs::of(inputs).joint, LEADING, [2, reference], None, grid)
    }

    /// Within and across views.
    fn rotary(&self, inputs: &[Tensor], grid: ViewGrid, _: bool) -> Rotary {
        let tokens = LEADING + grid.patches();
        Rotary { table: Inputs::of(inputs).rotary, tokens, turned: tokens }
    }

    fn write(
        &self,
        run: &mut Run,
        inputs: &[Tensor],
        grid: ViewGrid,
        _: Option<&[[f32; POSE_ENCODING]]>,
        parameters: &Parameters,
    ) -> Result<()> {
        let (a, ViewGrid { rows, columns, .. }, inputs) = (&self.architecture, grid, Inputs::of(inputs));
        let learned = &parameters[self.learned_positions];
        let mut positions = interpolate_antialiased(learned, a.position_grid, a.width, rows, columns);
        positions.splice(a.width..a.width, std::iter::repeat_n(0.0, REGISTERS * a.width));
        run.write(inputs.positions, &positions)?;
        run.write(inputs.embedding, &self.embedding.map(|part| &parameters[part]).concat())?;
        let kind = |kind: usize| {
            let half = |part| parameters[part].chunks(parameters[part].len() / 2).nth(kind).unwrap_or_default();
            self.joint.map(half).concat()
        };
        run.write(inputs.joint, &[kind(0), kind(1)].concat())?;
        run.write(inputs.rotary, &rotary_table(LEADING, rows, columns, a.head_dim()))
    }
}

/// Bicubic parameter.
const A: f64 = -0.5;

/// Interpolates learned positions `[1 + side * side, width]` to `[1 + rows * columns, width]`,
/// bicubic with antialiasing and normalized weights.
pub fn interpolate_antialiased(learned: &[f32], side: usize, width: usize, rows: usize, columns: usize) -> Vec<f32> {
    interpolate(learned, [side, width], [rows, columns], taps)
}

fn taps(side: usize, count: usize) -> Taps {
    let scale = side as f64 / count as f64;
    let spread = scale.max(1.0);
    let one = |i: usize| {
        let center = scale * (i as f64 + 0.5);
        let [first, end] = [-2.0, 2.0].map(|side| (center + side * spread + 0.5).max(0.0) as usize);
        let weight = |j: usize| (j, cubic((j as f64 + 0.5 - center) / spread, A));
        let mut taps: Vec<_> = (first..end.min(side)).map(weight).collect();
        let total: f64 = taps.iter().map(|(_, weight)| weight).sum();
        taps.iter_mut().for_each(|(_, weight)| *weight /= total);
        taps
    };
    (0..count).map(one).collect()
}
