use super::convolution::{Convolution, ConvolutionOptions};
use crate::{
    gpu::Recorder,
    ops::{FeatureMap, ParameterLayout, add},
};

/// Fusion steps, shallowest first.
pub(super) struct Fusion {
    steps: [Step; 4],
    suffix: &'static str,
}

struct Step {
    level: Option<Residual>,
    sum: Residual,
    out: Convolution,
}

/// x + convolution(relu(convolution(relu(x)))), or relu(x) + ..
struct Residual {
    layers: [Convolution; 2],
    rectified: bool,
}

impl Residual {
    fn new(p: &mut ParameterLayout, name: &str, channels: usize, rectified: bool) -> Self {
        let layers = [1, 2].map(|i| Convolution::new(p, &format!("{name}.conv{i}"), [channels; 2], 3));
        Self { layers, rectified }
    }

    fn record(&self, rec: &mut Recorder, x: FeatureMap) -> FeatureMap {
        let rectified = ConvolutionOptions::RECTIFIED;
        let hidden = self.layers[0].record(rec, "hidden", x, rectified);
        let sum = ConvolutionOptions { residual: Some(x), residual_rectified: self.rectified, ..rectified };
        self.layers[1].record(rec, "residual", hidden, sum)
    }
}

impl Fusion {
    /// `rectified` applies ReLU to the residual too.
    pub fn new(p: &mut ParameterLayout, root: &str, suffix: &'static str, channels: usize, rectified: bool) -> Self {
        let step = |j: usize| {
            let name = format!("{root}.scratch.refinenet{}{suffix}", j + 1);
            Step {
                level: (j < 3).then(|| Residual::new(p, &format!("{name}.resConfUnit1"), channels, rectified)),
                sum: Residual::new(p, &format!("{name}.resConfUnit2"), channels, rectified),
                out: Convolution::new(p, &format!("{name}.out_conv"), [channels; 2], 1),
            }
        };
        Self { steps: [0, 1, 2, 3].map(step), suffix }
    }

    pub fn record(&self, rec: &mut Recorder, tap: &str, levels: &[FeatureMap; 4]) -> FeatureMap {
        let mut below: Option<FeatureMap> = None;
        for (j, step) in self.steps.iter().enumerate().rev() {
            let mut x = levels[j];
            if let (Some(level), Some(below)) = (&step.level, below) {
                x = level.record(rec, x);
                add(rec, x.rows, below.rows);
            }
            let x = step.sum.record(rec, x);
            // Commutes with interpolation, at a quarter of the cost.
            let x = step.out.record(rec, "mixed", x, ConvolutionOptions::default());
            let size = if j > 0 { levels[j - 1].size() } else { x.size().map(|length| 2 * length) };
            let x = x.resized(rec, "fused", size, None);
            rec.observe(&format!("{tap}/fuse{j}{}", self.suffix), x.rows.tensor);
            below = Some(x);
        }
        below.expect("four steps")
    }
}
