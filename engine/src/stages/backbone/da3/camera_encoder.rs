use crate::{
    gpu::{Element, Recorder, Tensor},
    ops::{Activation, Block, Epilogue, Ffn, Heads, Linear, Norm, ParameterLayout, Rows, Sequences},
    stages::{CameraArchitecture, POSE_ENCODING},
};

const EPS: f32 = 1e-5;

pub(super) struct CameraEncoder {
    trunk: Vec<Block>,
    token_norm: Norm,
    trunk_norm: Norm,
    fc1: Linear,
    fc2: Linear,
}

impl CameraEncoder {
    pub fn new(p: &mut ParameterLayout, a: &CameraArchitecture, width: usize) -> Self {
        let root = &a.root;
        let heads = Heads::new(a.heads, width);
        let block = |p: &mut ParameterLayout, i| {
            Block::new(p, &format!("{root}.trunk.{i}"), heads, false, Ffn::Gelu, a.hidden, EPS)
        };
        Self {
            trunk: (0..a.depth).map(|i| block(p, i)).collect(),
            token_norm: p.norm(&format!("{root}.token_norm"), width, EPS),
            trunk_norm: p.norm(&format!("{root}.trunk_norm"), width, EPS),
            fc1: p.exact_linear(&format!("{root}.pose_branch.fc1"), POSE_ENCODING, a.pose_hidden),
            fc2: p.exact_linear(&format!("{root}.pose_branch.fc2"), a.pose_hidden, width),
        }
    }

    /// Returns a token per pose; the views form one sequence.
    pub fn record(&self, rec: &mut Recorder, poses: Rows) -> Tensor {
        rec.scope("camera_encoder", |rec| {
            let gelu = Epilogue { activation: Activation::Gelu, ..Epilogue::default() };
            let hidden = self.fc1.apply(rec, "pose", poses, Element::F32, gelu);
            let embedded = self.fc2.apply(rec, "embedded", hidden, Element::F32, Epilogue::default());
            let x = self.token_norm.apply(rec, embedded, Element::F32);
            for block in &self.trunk {
                block.record(rec, x, Sequences { count: 1, tokens: x.count, rotary: None, pool: None });
            }
            let tokens = self.trunk_norm.apply(rec, x, Element::F32).tensor;
            rec.observe("bb/cam_token", tokens);
            tokens
        })
    }
}
