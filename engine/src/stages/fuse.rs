//! Fusion: selected tokens attend to all tokens and each other.
//!
//! Source: ZipSplat, section 3.1, "Token refinement".

use crate::{
    gpu::{Element, Recorder, Tensor},
    ops::{Block, CrossBlock, Ffn, Heads, ParameterLayout, Rows, Sequences, add, gather_rows},
    stages::Architecture,
};

const EPS: f32 = 1e-5;

pub struct Fuse {
    cross: Vec<CrossBlock>,
    own: Vec<Block>,
}

impl Fuse {
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        let heads = Heads::new(a.fusion_heads, a.width);
        let layers = 0..a.out_layers.len();
        let name = |kind: &str, layer: usize| format!("{kind}_attention.{layer}");
        let cross =
            layers.clone().map(|l| CrossBlock::new(p, &name("cross", l), heads, a.fusion_hidden, EPS)).collect();
        let own =
            layers.map(|l| Block::new(p, &name("self", l), heads, true, Ffn::Gelu, a.fusion_hidden, EPS)).collect();
        Self { cross, own }
    }

    /// `layers` are deepest first; fuses `count` tokens `chosen`, or all.
    pub fn record(&self, rec: &mut Recorder, layers: &[Rows], chosen: Option<(Tensor, usize)>) -> Rows {
        let pick = |rec: &mut Recorder, layer: Rows| match chosen {
            Some((indices, count)) => gather_rows(rec, layer, indices, count),
            None => layer,
        };
        let first = pick(rec, layers[0]);
        let scene = Rows::scratch(rec, "scene", first.count, first.width, Element::F32);
        rec.copy(first.tensor, scene.tensor);
        rec.observe("scene_init", scene.tensor);
        for (l, ((cross, own), layer)) in self.cross.iter().zip(&self.own).zip(layers).enumerate() {
            let queries = if l == 0 { first } else { pick(rec, *layer) };
            let delta = rec.scope("cross", |rec| cross.record(rec, queries, *layer));
            rec.observe(&format!("ca{l}_delta"), delta.tensor);
            add(rec, scene, delta);
            rec.observe(&format!("scene_ca{l}"), scene.tensor);
            let sequences = Sequences { count: 1, tokens: scene.count, rotary: None, pool: None };
            rec.scope("self", |rec| own.record(rec, scene, sequences));
            rec.observe(&format!("scene_sa{l}"), scene.tensor);
        }
        scene
    }
}
