//! VGGT's camera head: encodings refined in a few passes of one transformer over the views.

use super::camera::CameraTensors;
use crate::{
    gpu::{Element, Recorder},
    kernels::{heads::Modulate, ops::Gelu},
    ops::{
        Activation, Block, Epilogue, Ffn, Heads, HostParameter, Linear, Norm, ParameterLayout, Rows, Sequences, add,
        place_columns,
    },
    stages::{CameraArchitecture, POSE_ENCODING, POSE_VALUES},
};

const EPS: f32 = 1e-5;
/// Of the norm that is modulated.
const MODULATED_EPS: f32 = 1e-6;
const ITERATIONS: usize = 4;

pub(super) struct PoseHead {
    empty: HostParameter,
    embed: Linear,
    modulation: Linear,
    token_norm: Norm,
    trunk: Vec<Block>,
    trunk_norm: Norm,
    fc1: Linear,
    fc2: Linear,
}

impl PoseHead {
    /// Always f32.
    pub fn new(p: &mut ParameterLayout, a: &CameraArchitecture, width: usize) -> Self {
        let root = &a.root;
        let heads = Heads::new(a.heads, width);
        let block = |p: &mut ParameterLayout, i| {
            Block::new(p, &format!("{root}.trunk.{i}"), heads, false, Ffn::Gelu, a.hidden, EPS)
        };
        p.exactly(|p| Self {
            empty: p.host(&format!("{root}.empty_pose_tokens"), &[1, 1, POSE_ENCODING]),
            embed: p.linear(&format!("{root}.embed_pose"), POSE_ENCODING, width),
            modulation: p.linear(&format!("{root}.poseLN_modulation.1"), width, 3 * width),
            token_norm: p.norm(&format!("{root}.token_norm"), width, EPS),
            trunk: (0..a.depth).map(|i| block(p, i)).collect(),
            trunk_norm: p.norm(&format!("{root}.trunk_norm"), width, EPS),
            fc1: p.linear(&format!("{root}.pose_branch.fc1"), width, a.pose_hidden),
            fc2: p.linear(&format!("{root}.pose_branch.fc2"), a.pose_hidden, POSE_ENCODING),
        })
    }

    /// Each pass modulates the same tokens by the encodings so far.
    pub fn record(&self, rec: &mut Recorder, tokens: Rows) -> CameraTensors {
        let views = tokens.count;
        let initial = rec.input::<[f32; POSE_VALUES]>("poses", views);
        let given = Rows::new(initial, views, POSE_VALUES);
        let token = self.token_norm.apply(rec, tokens, Element::F32);
        rec.observe("cam/tokens", token.tensor);
        let mut encodings: Option<Rows> = None;
        for k in 0..ITERATIONS {
            let x = self.modulated(rec, token, given);
            rec.observe(&format!("cam/modulated{k}"), x.tensor);
            for block in &self.trunk {
                block.record(rec, x, Sequences { count: 1, tokens: views, rotary: None, pool: None });
            }
            rec.observe(&format!("cam/trunk{k}"), x.tensor);
            let normed = self.trunk_norm.apply(rec, x, Element::F32);
            let gelu = Epilogue { activation: Activation::Gelu, ..Epilogue::default() };
            let hidden = self.fc1.apply(rec, "pose", normed, Element::F32, gelu);
            let delta = self.fc2.apply(rec, "delta", hidden, Element::F32, Epilogue::default());
            rec.observe(&format!("cam/delta{k}"), delta.tensor);
            encodings.into_iter().for_each(|sum| add(rec, sum, delta));
            let sum = *encodings.get_or_insert(delta);
            rec.observe(&format!("cam/pose_enc{k}"), sum.tensor);
            place_columns(rec, sum, given, 0);
        }
        let encodings = encodings.expect("at least one pass").tensor;
        rec.output(encodings);
        CameraTensors::Iterated { encodings, initial, empty: self.empty }
    }

    fn modulated(&self, rec: &mut Recorder, token: Rows, given: Rows) -> Rows {
        let (rows, width) = (token.count, token.width as u32);
        let embedded = self.embed.apply(rec, "embedded", given, Element::F32, Epilogue::default());
        let (source, count) = (embedded.tensor, embedded.values() as u32);
        let silu = Gelu { source, gradient: source, out: source, count, backward: false, silu: true };
        rec.dispatch(silu, embedded.values());
        let modulation = self.modulation.apply(rec, "modulation", embedded, Element::F32, Epilogue::default());
        let out = Rows::scratch(rec, "modulated", rows, token.width, Element::F32);
        let kernel = Modulate {
            source: token.tensor,
            modulation: modulation.tensor,
            out: out.tensor,
            rows: rows as u32,
            width,
            eps: MODULATED_EPS,
        };
        rec.dispatch_groups(kernel, rows);
        out
    }
}
