//! Convolutions of feature maps.

use crate::{
    gpu::Recorder,
    kernels::{heads as kernels, limits::LINEAR_ROWS},
    ops::{FeatureMap, Linear, ParameterLayout, row_chunks},
};

/// A convolution with an odd kernel, the map 0 outside.
pub(super) struct Convolution {
    layer: Linear,
    side: usize,
    step: usize,
}

/// What is done to a map before and behind a convolution.
#[derive(Clone, Copy, Default)]
pub(super) struct How {
    /// Its values are at least 0 before.
    pub rectified: bool,
    /// The exact GELU behind the bias.
    pub gelu: bool,
    /// Added in the end; as large as the result.
    pub residual: Option<FeatureMap>,
}

impl Convolution {
    /// Declares `NAME.weight` and `NAME.bias`.
    pub fn new(p: &mut ParameterLayout, name: &str, channels: [usize; 2], side: usize) -> Self {
        Self { layer: p.planar_convolution(name, channels, side, true), side, step: 1 }
    }

    /// The same for every second pixel.
    pub fn strided(self) -> Self {
        Self { step: 2, ..self }
    }

    /// Declares `NAME.weight` of a 3 x 3 convolution without bias.
    pub fn unbiased(p: &mut ParameterLayout, name: &str, channels: [usize; 2]) -> Self {
        Self { layer: p.planar_convolution(name, channels, 3, false), side: 3, step: 1 }
    }

    /// Declares `NAME.weight` `[outputs, inputs]` and `NAME.bias`: one tap, whose weight has no sides.
    pub fn linear(p: &mut ParameterLayout, name: &str, [inputs, outputs]: [usize; 2]) -> Self {
        Self { layer: p.exact_linear(name, inputs, outputs), side: 1, step: 1 }
    }

    /// Records the convolution of a map.
    pub fn record(&self, rec: &mut Recorder, name: &str, source: FeatureMap, how: How) -> FeatureMap {
        let (Self { layer, side, step }, padding) = (self, self.side / 2);
        let size = source.size().map(|length| (length + 2 * padding - side) / step + 1);
        let out = FeatureMap::scratch(rec, name, size, layer.columns);
        let across = layer.columns.div_ceil(4 * rec.limits().subgroup_size as usize);
        // Lines of the source for one, with room for those next to the part.
        let seen = step + 2 * padding + 1;
        for lines in row_chunks(rec, out.height, &[out.line_bytes(), seen * source.line_bytes()]) {
            let first = (lines.start * step).saturating_sub(padding);
            let (values, source_first) = source.seen(first..(lines.end - 1) * step + side - padding);
            let pixels = lines.len() * out.width;
            let kernel = kernels::Convolution {
                source: values,
                weight: layer.weight,
                bias: layer.bias,
                residual: how.residual.map_or(layer.bias, |residual| residual.lines(lines.clone())),
                out: out.lines(lines.clone()),
                pixels: pixels as u32,
                first: (lines.start * out.width) as u32,
                out_width: out.width as u32,
                columns: layer.columns as u32,
                channels: source.channels() as u32,
                width: source.width as u32,
                height: source.height as u32,
                source_first,
                side: *side as u32,
                step: *step as u32,
                padding: padding as u32,
                rectified: how.rectified,
                gelu: how.gelu,
                add: how.residual.is_some(),
            };
            let flops = 2 * pixels * layer.inner * layer.columns;
            rec.dispatch_groups(kernel, pixels.div_ceil(LINEAR_ROWS as usize) * across).flops(flops as u64);
        }
        out
    }
}
