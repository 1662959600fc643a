//! Decoding of scene tokens to Gaussians.
//!
//! Source: ZipSplat, section 3.2 and appendix A.

mod head;

use super::{Architecture, SceneTensors, ViewGrid, coeffs_of, embed_patches};
use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::gaussians as kernels,
    ops::{
        Activation, CrossBlock, Epilogue, Heads, Linear, ParameterLayout, Rows, add, gather_rows, join_columns,
        row_chunks,
    },
};

pub use head::{Head, HeadKept};

const EPS: f32 = 1e-5;

pub struct Gaussians {
    color_embed: Linear,
    color_cross: CrossBlock,
    head: [Linear; 3],
}

impl Gaussians {
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        let heads = Heads::new(a.color_heads, a.color_width);
        Self {
            color_embed: p.convolution("color_embed.proj", &[3, a.patch_size, a.patch_size], a.color_width),
            color_cross: CrossBlock::new(p, "color_cross_attention", heads, a.color_hidden, EPS),
            head: head::layers(a).map(|(name, inner, columns)| p.linear(&name, inner, columns)),
        }
    }

    /// Returns f32 colors of the tokens `chosen`, or all.
    pub fn colors(&self, rec: &mut Recorder, images: Tensor, grid: ViewGrid, chosen: Option<(Tensor, usize)>) -> Rows {
        rec.scope("color", |rec| {
            let tokens = embed_patches(rec, images, grid, &self.color_embed, false);
            rec.observe("color/tokens", tokens.tensor);
            let queries = match chosen {
                Some((indices, count)) => gather_rows(rec, tokens, indices, count),
                None => tokens,
            };
            let delta = self.color_cross.record(rec, queries, tokens);
            add(rec, delta, queries);
            rec.observe("color_feats", delta.tensor);
            delta
        })
    }

    /// Records the head for f32 scene tokens and colors. A token's Gaussians are consecutive.
    pub fn record(&self, rec: &mut Recorder, tokens: [Rows; 2], scene_scale: Tensor, into: &SceneTensors) {
        let raw = rec.scope("head", |rec| {
            let [first, second, third] = &self.head;
            let joined = join_columns(rec, tokens, first.element());
            let gelu = Epilogue { activation: Activation::Gelu, ..Epilogue::default() };
            let hidden = first.apply(rec, "hidden", joined, second.element(), gelu);
            let narrow = second.apply(rec, "narrow", hidden, third.element(), Epilogue::default());
            third.apply(rec, "raw", narrow, Element::F32, Epilogue::default()).tensor
        });
        rec.observe("raw", raw);
        activate(rec, raw, scene_scale, into);
    }
}

/// Activates `raw` `[len, 11 + 3 (sh_degree + 1)^2]`; `scene_scale` (`[1]` f32) scales lengths.
pub fn activate(rec: &mut Recorder, raw: Tensor, scene_scale: Tensor, into: &SceneTensors) {
    let width = SceneTensors::width(into.sh_degree);
    let widths = SceneTensors::widths(into.sh_degree).map(|width| 4 * width);
    for part in row_chunks(rec, into.len, &[&widths[..], &[4 * width]].concat()) {
        let raw = raw.slice::<f32>(part.start * width, part.len() * width);
        let SceneTensors { means, scales, quats, opacities, sh_coeffs, len, .. } = into.part(part);
        let (count, bases) = (len as u32, coeffs_of(into.sh_degree) as u32);
        let unit = scene_scale;
        rec.dispatch(kernels::Activate { raw, unit, means, scales, quats, opacities, sh_coeffs, count, bases }, len);
    }
}
