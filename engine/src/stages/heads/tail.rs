use super::convolution::{Convolution, ConvolutionOptions};
use crate::{
    gpu::{Recorder, Tensor},
    ops::{FeatureMap, ParameterLayout},
};

const HIDDEN: usize = 32;

pub(super) struct Tail([Convolution; 2]);

impl Tail {
    pub fn new(p: &mut ParameterLayout, name: &str, inputs: usize, outputs: usize) -> Self {
        let hidden = Convolution::new(p, &format!("{name}.0"), [inputs, HIDDEN], 3);
        Self([hidden, Convolution::new(p, &format!("{name}.2"), [HIDDEN, outputs], 1)])
    }

    pub fn record(&self, rec: &mut Recorder, tap: &str, x: FeatureMap) -> Tensor {
        let hidden = self.0[0].record(rec, "hidden", x, ConvolutionOptions::default());
        let logits = self.0[1].record(rec, "logits", hidden, ConvolutionOptions::RECTIFIED).rows.tensor;
        rec.observe(tap, logits);
        rec.output(logits);
        logits
    }
}
