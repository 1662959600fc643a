use super::{
    convolution::{Convolution, ConvolutionOptions},
    fusion::Fusion,
    position::Positions,
};
use crate::{
    gpu::{Element, Recorder, Tensor},
    ops::{FeatureMap, Norm, ParameterLayout},
};

const HIDDEN: usize = 32;
/// Direction, origin, log (confidence - 1).
const VALUES: usize = 7;
const EPS: f32 = 1e-5;

pub(super) struct RayHead {
    fusion: Fusion,
    neck: [Convolution; 5],
    hidden: Convolution,
    norm: Norm,
    out: Convolution,
}

impl RayHead {
    /// Checkpoints store the tails' shared norm with the first tail; only the last tail is used.
    pub fn new(p: &mut ParameterLayout, root: &str, f: usize) -> Self {
        let name = |part: String| format!("{root}.scratch.{part}");
        let neck = |i: usize| if i.is_multiple_of(2) { [f, f / 2] } else { [f / 2, f] };
        Self {
            fusion: Fusion::new(p, root, "_aux", f, false),
            neck: [0, 1, 2, 3, 4].map(|i| Convolution::new(p, &name(format!("output_conv1_aux.3.{i}")), neck(i), 3)),
            hidden: Convolution::new(p, &name("output_conv2_aux.3.0".into()), [f / 2, HIDDEN], 3),
            norm: p.norm(&name("output_conv2_aux.0.2".into()), HIDDEN, EPS),
            out: Convolution::new(p, &name("output_conv2_aux.3.5".into()), [HIDDEN, VALUES], 1),
        }
    }

    pub fn record(&self, rec: &mut Recorder, levels: &[FeatureMap; 4], positions: &mut Positions) -> Tensor {
        let mut x = self.fusion.record(rec, "head", levels);
        for (i, layer) in self.neck.iter().enumerate() {
            x = layer.record(rec, "neck", x, ConvolutionOptions::default());
            rec.observe(&format!("head/neck_aux{i}"), x.rows.tensor);
        }
        let placed = x.resized(rec, "placed", x.size(), Some(positions));
        let hidden = self.hidden.record(rec, "hidden", placed, ConvolutionOptions::default());
        let normed = FeatureMap::new(self.norm.apply(rec, hidden.rows, Element::F32), hidden.size());
        let logits = self.out.record(rec, "logits", normed, ConvolutionOptions::RECTIFIED).rows.tensor;
        rec.observe("head/logits_aux", logits);
        rec.output(logits);
        logits
    }
}
