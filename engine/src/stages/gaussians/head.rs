//! Differentiable Gaussian head, frozen and f32 in every precision.

use super::activate;
use crate::{
    gpu::{Element, Recorder, ResidentLayout, Tensor},
    kernels::{gaussians as kernels, ops::Gelu},
    ops::{Epilogue, Linear, ParameterLayout, Rows, row_chunks},
    stages::{Architecture, SceneTensors, coeffs_of},
};

pub struct Head {
    layers: [Linear; 3],
    transposed: [Linear; 3],
    gaussians_per_token: usize,
}

/// Activations kept for the backward pass.
#[derive(Clone, Copy, Debug)]
pub struct HeadKept {
    /// Before GELU, `[count, head_hidden]` f32.
    hidden: Rows,
    /// Before activation, `[count, gaussians_per_token * gaussian_width]` f32.
    raw: Rows,
    scene_scale: Tensor,
}

/// Name, inner width, columns.
pub(super) fn layers(a: &Architecture) -> [(String, usize, usize); 3] {
    let (root, joined) = ("gaussian_head.gaussian_head", a.width + a.color_width);
    [
        (format!("{root}.0.fc1"), joined, a.head_hidden),
        (format!("{root}.0.fc2"), a.head_hidden, joined),
        (format!("{root}.1"), joined, a.gaussians_per_token * a.gaussian_width()),
    ]
}

impl Head {
    pub fn new(p: &mut ParameterLayout, a: &Architecture) -> Self {
        Self {
            layers: layers(a).map(|(name, inner, columns)| p.exact_linear(&name, inner, columns)),
            transposed: layers(a).map(|(name, inner, columns)| p.transposed_linear(&name, inner, columns)),
            gaussians_per_token: a.gaussians_per_token,
        }
    }

    pub fn keep(&self, layout: &mut ResidentLayout, count: usize, scene_scale: Tensor) -> HeadKept {
        let mut rows = |layer: &Linear| Rows::new(layout.add::<f32>(count * layer.columns), count, layer.columns);
        let [first, _, third] = &self.layers;
        HeadKept { hidden: rows(first), raw: rows(third), scene_scale }
    }

    /// `tokens` are f32 scene tokens, then colors. `scene_scale` (`[1]` f32) scales lengths.
    pub fn record(&self, rec: &mut Recorder, tokens: Rows, scene_scale: Tensor, into: &SceneTensors) -> HeadKept {
        let [first, _, third] = &self.layers;
        let kept = rec.scope("head", |rec| {
            let mut rows = |name, layer: &Linear| Rows::scratch(rec, name, tokens.count, layer.columns, Element::F32);
            HeadKept { hidden: rows("hidden", first), raw: rows("raw", third), scene_scale }
        });
        self.record_kept(rec, tokens.tensor, &kept, into);
        kept
    }

    /// [`Head::record`] with persistent activations.
    pub fn record_kept(&self, rec: &mut Recorder, tokens: Tensor, kept: &HeadKept, into: &SceneTensors) {
        rec.scope("head", |rec| {
            let ([first, second, third], HeadKept { hidden, raw, scene_scale }) = (&self.layers, *kept);
            let tokens = Rows::new(tokens, hidden.count, first.inner);
            first.record(rec, tokens, hidden, Epilogue::default());
            let activated = Rows::scratch(rec, "activated", hidden.count, hidden.width, Element::F32);
            gelu(rec, hidden, None, activated);
            let narrow = second.apply(rec, "narrow", activated, Element::F32, Epilogue::default());
            third.record(rec, narrow, raw, Epilogue::default());
            rec.observe("raw", raw.tensor);
            activate(rec, raw.tensor, scene_scale, into);
        });
    }

    /// Returns the token gradient, `[count, width + color_width]` f32.
    pub fn record_backward(&self, rec: &mut Recorder, kept: &HeadKept, d_gaussians: &SceneTensors) -> Tensor {
        rec.scope("head backward", |rec| {
            let [first, second, third] = &self.transposed;
            let d_raw = self.activate_backward(rec, kept, d_gaussians, third.inner);
            rec.observe("d_raw", d_raw.tensor);
            let d_narrow = third.apply(rec, "d_narrow", d_raw, Element::F32, Epilogue::default());
            let d_hidden = second.apply(rec, "d_hidden", d_narrow, Element::F32, Epilogue::default());
            gelu(rec, kept.hidden, Some(d_hidden), d_hidden);
            let d_tokens = first.apply(rec, "d_tokens", d_hidden, Element::F32, Epilogue::default()).tensor;
            rec.observe("d_tokens", d_tokens);
            d_tokens
        })
    }

    fn activate_backward(&self, rec: &mut Recorder, kept: &HeadKept, d: &SceneTensors, stride: usize) -> Rows {
        let (group, width) = (self.gaussians_per_token, SceneTensors::width(d.sh_degree));
        let d_raw = Rows::scratch(rec, "d_raw", kept.raw.count, stride, Element::F32);
        if stride > group * width {
            rec.fill(d_raw.tensor, 0); // padding is multiplied by zeros and must be finite
        }
        let widths = SceneTensors::widths(d.sh_degree).map(|width| 4 * group * width);
        for part in row_chunks(rec, d_raw.count, &[&widths[..], &[4 * group * width, d_raw.row_bytes()]].concat()) {
            let d = d.part(part.start * group..part.end * group);
            let kernel = kernels::ActivateBackward {
                raw: kept.raw.part(part.clone()).tensor,
                unit: kept.scene_scale,
                d_means: d.means,
                d_scales: d.scales,
                d_quats: d.quats,
                d_opacities: d.opacities,
                d_sh_coeffs: d.sh_coeffs,
                d_raw: d_raw.part(part).tensor,
                count: d.len as u32,
                bases: coeffs_of(d.sh_degree) as u32,
                group: group as u32,
                stride: stride as u32,
            };
            rec.dispatch(kernel, d.len);
        }
        d_raw
    }
}

/// GELU, or its backward pass with a `gradient`, which `out` may alias.
fn gelu(rec: &mut Recorder, source: Rows, gradient: Option<Rows>, out: Rows) {
    let backward = gradient.is_some();
    let rows = [source, gradient.unwrap_or(source), out];
    for part in row_chunks(rec, out.values(), &[size_of::<f32>()]) {
        let [source, gradient, out] = rows.map(|rows| rows.tensor.slice::<f32>(part.start, part.len()));
        rec.dispatch(Gelu { source, gradient, out, count: part.len() as u32, backward, silu: false }, part.len());
    }
}
