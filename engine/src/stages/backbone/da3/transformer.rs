use super::{
    camera_encoder::{CameraEncoder, POSE_ENCODING, POSE_VALUES},
    positions::{interpolate, rotary_tables},
};
use crate::{
    Result,
    gpu::{Element, Recorder, Run, Tensor},
    kernels::backbone as kernels,
    ops::{Block, Heads, HostParameter, Linear, Norm, ParameterLayout, Parameters, Pool, Rotary, Rows, Sequences},
    stages::{BackboneArchitecture, Reference, ViewGrid, embed_patches},
};

const EPS: f32 = 1e-6;

pub(super) struct Transformer {
    architecture: BackboneArchitecture,
    class_token: Tensor,
    /// `[2, width]` f32.
    camera_tokens: Option<Tensor>,
    learned_positions: HostParameter,
    patch_embed: Linear,
    blocks: Vec<Block>,
    pub final_norm: Norm,
    camera_encoder: Option<CameraEncoder>,
}

/// Tokens at an out layer, camera tokens first.
#[derive(Clone, Copy)]
pub(super) struct OutLayer {
    pub local: Rows,
    pub global: Rows,
}

struct Inputs<'a> {
    positions: Tensor,
    /// Local, global.
    rotary: Option<&'a [Tensor]>,
    poses: Option<Tensor>,
}

impl Transformer {
    pub fn new(p: &mut ParameterLayout, a: &BackboneArchitecture) -> Self {
        let root = &a.root;
        let heads = Heads::new(a.heads, a.width);
        Self {
            class_token: p.vector(&format!("{root}.cls_token"), &[1, 1, a.width]),
            camera_tokens: a.alternates().then(|| p.vector(&format!("{root}.camera_token"), &[1, 2, a.width])),
            learned_positions: p.host(&format!("{root}.pos_embed"), &[1, 1 + a.position_grid.pow(2), a.width]),
            patch_embed: p.convolution(&format!("{root}.patch_embed.proj"), &[3, a.patch_size, a.patch_size], a.width),
            blocks: (0..a.depth)
                .map(|i| {
                    let name = format!("{root}.blocks.{i}");
                    Block::new(p, &name, heads, i >= a.qk_norm_start, (a.ffn, a.ffn_hidden), EPS)
                })
                .collect(),
            final_norm: p.norm(&format!("{root}.norm"), a.width, a.final_eps),
            camera_encoder: a.camera.as_ref().map(|camera| CameraEncoder::new(p, camera, a.width)),
            architecture: a.clone(),
        }
    }

    /// Allocates positions ([`interpolate`]), tables ([`rotary_tables`]) and poses `[views,
    /// POSE_VALUES]`, f32.
    pub fn inputs(&self, rec: &mut Recorder, grid: ViewGrid, cameras: bool) -> Vec<Tensor> {
        let (a, tokens) = (&self.architecture, 1 + grid.patches());
        let mut inputs = vec![rec.input::<f32>("positions", tokens * a.width)];
        if a.rotates() {
            let tables = [("rotary_local", tokens), ("rotary_global", 1)];
            inputs.extend(tables.map(|(name, turned)| rec.input::<f32>(name, turned * a.head_dim())));
        }
        inputs.extend(cameras.then(|| rec.input::<[f32; POSE_VALUES]>("poses", grid.views)));
        inputs
    }

    fn named<'a>(&self, inputs: &'a [Tensor]) -> Inputs<'a> {
        let (positions, rest) = (inputs[0], &inputs[1..]);
        let (rotary, poses) = rest.split_at(if self.architecture.rotates() { 2 } else { 0 });
        Inputs { positions, rotary: (!rotary.is_empty()).then_some(rotary), poses: poses.first().copied() }
    }

    pub fn record(
        &self,
        rec: &mut Recorder,
        images: Tensor,
        inputs: &[Tensor],
        (grid, reference, pool): (ViewGrid, Reference, usize),
        mut out: impl FnMut(&mut Recorder, usize, OutLayer),
    ) {
        let (a, tokens) = (&self.architecture, 1 + grid.patches());
        let Inputs { positions, rotary, poses } = self.named(inputs);
        let encoder = self.camera_encoder.as_ref();
        let encoded =
            poses.zip(encoder).map(|(poses, encoder)| encoder.record(rec, Rows::new(poses, grid.views, POSE_VALUES)));
        let x = self.first_tokens(rec, images, positions, grid);
        let mut chosen = None;
        // Copied before a global block overwrites it.
        let mut local = x;
        for (i, block) in self.blocks.iter().enumerate() {
            if i + 1 == a.alt_start && reference == Reference::Balanced && encoded.is_none() {
                chosen = Some(choose_reference(rec, x, grid));
            }
            if let (true, Some(learned)) = (i == a.alt_start, self.camera_tokens) {
                self.insert_camera_tokens(rec, x.tensor, (encoded, learned), (reference, chosen), grid);
                rec.observe("bb/alt_in", x.tensor);
            }
            let (global, out_layer) = (a.is_global(i), a.out_layers.iter().position(|&layer| layer == i));
            if global && out_layer.is_some() {
                local = Rows::scratch(rec, "local", x.count, x.width, Element::F32);
                rec.copy(x.tensor, local.tensor);
            } else if !global {
                local = x;
            }
            let rotary = rotary.filter(|_| i >= a.rope_start).map(|tables| Rotary {
                table: tables[usize::from(global)],
                tokens,
                turned: if global { 1 } else { tokens },
            });
            let sequences = Sequences {
                count: if global { 1 } else { grid.views },
                tokens: if global { grid.views * tokens } else { tokens },
                rotary,
                pool: Pool::of(pool, [grid.rows, grid.columns], 1).filter(|_| global),
            };
            rec.scope("block", |rec| block.record(rec, x, sequences));
            rec.observe(&format!("bb/block{i}"), x.tensor);
            if let Some(layer) = out_layer {
                rec.scope("features", |rec| out(rec, layer, OutLayer { local, global: x }));
            }
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

    fn insert_camera_tokens(
        &self,
        rec: &mut Recorder,
        x: Tensor,
        (encoded, learned): (Option<Tensor>, Tensor),
        (reference, chosen): (Reference, Option<Tensor>),
        grid: ViewGrid,
    ) {
        let width = self.architecture.width;
        let kernel = kernels::CameraToken {
            camera_tokens: encoded.unwrap_or(learned),
            chosen: chosen.unwrap_or(learned),
            out: x,
            views: grid.views as u32,
            tokens: 1 + grid.patches() as u32,
            width: width as u32,
            reference: if let Reference::View(view) = reference { view as u32 } else { 0 },
            encoded: encoded.is_some(),
            on_device: chosen.is_some(),
        };
        rec.dispatch(kernel, grid.views * width);
    }

    pub fn write(
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
        run.write(inputs.positions, &interpolate(learned, a.position_grid, a.width, rows, columns))?;
        for (tensor, table) in inputs.rotary.into_iter().flatten().zip(rotary_tables(rows, columns, a.head_dim())) {
            run.write(*tensor, &table)?;
        }
        if let (Some(tensor), Some(poses)) = (inputs.poses, poses) {
            let padded = |e: &[f32; POSE_ENCODING]| std::array::from_fn(|i| e.get(i).copied().unwrap_or(0.0));
            run.write(tensor, &poses.iter().map(padded).collect::<Vec<[f32; POSE_VALUES]>>())?;
        }
        Ok(())
    }
}

/// Reference view `[1]` u32, by class tokens.
fn choose_reference(rec: &mut Recorder, x: Rows, grid: ViewGrid) -> Tensor {
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
    reference
}
