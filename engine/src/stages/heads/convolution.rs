use crate::{
    gpu::Recorder,
    kernels::{heads as kernels, limits::LINEAR_ROWS, ops::Im2col},
    ops::{FeatureMap, Linear, NARROWEST, ParameterLayout, UNIFORM_TILE, divides_panels, row_chunks, terms_of},
};
use std::ops::Range;

/// Sets the fields common to convolution kernels of the output's `lines`.
macro_rules! convolution_kernel {
    ($kernel:ident, $convolution:ident, $source:ident, $seen:expr, $out:ident, $lines:ident, $options:ident,
     { $($own:tt)* }) => {{
        let (layer, (values, source_first)) = (&$convolution.layer, $seen);
        kernels::$kernel {
            source: values,
            weight: layer.weight,
            bias: layer.bias,
            residual: $options.residual.map_or(layer.bias, |residual| residual.lines($lines.clone())),
            out: $out.lines($lines.clone()),
            pixels: ($lines.len() * $out.width) as u32,
            first: ($lines.start * $out.width) as u32,
            out_width: $out.width as u32,
            columns: layer.columns as u32,
            channels: $source.channels() as u32,
            source_first,
            side: $convolution.side as u32,
            step: $convolution.step as u32,
            gelu: $options.gelu,
            add: $options.residual.is_some(),
            add_rectified: $options.residual_rectified,
            $($own)*
        }
    }};
}

/// A zero-padded odd convolution over whole vec4 of channels.
pub struct Convolution {
    layer: Linear,
    side: usize,
    step: usize,
}

#[derive(Clone, Copy, Default)]
pub struct ConvolutionOptions {
    /// ReLU on the input.
    pub rectified: bool,
    /// Exact (erf) GELU.
    pub gelu: bool,
    pub residual: Option<FeatureMap>,
    /// ReLU on the residual.
    pub residual_rectified: bool,
}

impl ConvolutionOptions {
    pub const RECTIFIED: Self = Self { rectified: true, gelu: false, residual: None, residual_rectified: false };
}

impl Convolution {
    /// Wraps an f32 panel layer over `[side, side, channels]`.
    pub fn of(layer: Linear, [side, step]: [usize; 2]) -> Self {
        Self { layer, side, step }
    }

    pub(super) fn new(p: &mut ParameterLayout, name: &str, channels: [usize; 2], side: usize) -> Self {
        Self { layer: p.planar_convolution(name, channels, side, true), side, step: 1 }
    }

    pub(super) fn strided(self) -> Self {
        Self { step: 2, ..self }
    }

    pub(super) fn record(
        &self,
        rec: &mut Recorder,
        name: &str,
        source: FeatureMap,
        options: ConvolutionOptions,
    ) -> FeatureMap {
        let size = source.size().map(|length| (length + 2 * self.padding() - self.side) / self.step + 1);
        let out = FeatureMap::scratch(rec, name, size, self.layer.columns);
        self.record_into(rec, source, out, options);
        out
    }

    pub fn record_into(&self, rec: &mut Recorder, source: FeatureMap, out: FeatureMap, options: ConvolutionOptions) {
        if divides_panels(rec.limits()) {
            let bordered = self.bordered(rec, source, options.rectified);
            self.uniform(rec, bordered, out, options);
        } else {
            self.implicit(rec, source, out, options);
        }
    }

    fn padding(&self) -> usize {
        self.side / 2
    }

    fn implicit(&self, rec: &mut Recorder, source: FeatureMap, out: FeatureMap, options: ConvolutionOptions) {
        let (Self { layer, side, step }, padding) = (self, self.padding());
        let across = layer.columns.div_ceil(4 * rec.limits().subgroup_size as usize);
        // Input lines per output line, plus overlap.
        let seen = step + 2 * padding + 1;
        for lines in row_chunks(rec, out.height, &[out.line_bytes(), seen * source.line_bytes()]) {
            let first = (lines.start * step).saturating_sub(padding);
            let seen = source.seen(first..(lines.end - 1) * step + side - padding);
            let pixels = lines.len() * out.width;
            let kernel = convolution_kernel!(Convolution, self, source, seen, out, lines, options, {
                width: source.width as u32,
                height: source.height as u32,
                padding: padding as u32,
                rectified: options.rectified,
            });
            rec.dispatch_groups(kernel, pixels.div_ceil(LINEAR_ROWS as usize) * across).flops(self.flops(pixels));
        }
    }

    fn bordered(&self, rec: &mut Recorder, source: FeatureMap, rectified: bool) -> FeatureMap {
        let (padding, channels) = (self.padding(), source.channels());
        if padding == 0 && !rectified {
            return source;
        }
        let out = FeatureMap::scratch(rec, "bordered", source.size().map(|length| length + 2 * padding), channels);
        for lines in row_chunks(rec, out.height, &[out.line_bytes(), 2 * source.line_bytes()]) {
            let inside = |line: usize| line.saturating_sub(padding).min(source.height);
            let Range { start, end } = inside(lines.start)..inside(lines.end);
            let (values, source_first) = source.seen(start.min(source.height - 1)..end.max(1));
            let pixels = lines.len() * out.width;
            let kernel = Im2col {
                source: values,
                gate: values,
                out: out.lines(lines.clone()),
                rows: pixels as u32,
                row: channels as u32,
                first: (lines.start * out.width) as u32,
                out_width: out.width as u32,
                channels: channels as u32,
                width: source.width as u32,
                height: source.height as u32,
                source_first,
                side: 1,
                step: 1,
                padding: padding as u32,
                spread: 1,
                rectified,
                gated: false,
            };
            rec.dispatch_groups(kernel, pixels);
        }
        out
    }

    fn uniform(&self, rec: &mut Recorder, source: FeatureMap, out: FeatureMap, options: ConvolutionOptions) {
        let (Self { layer, side, step }, [tile_rows, vectors]) = (self, UNIFORM_TILE);
        let tile_columns = vectors * rec.limits().subgroup_size;
        let seen = step + side;
        let each = [out.line_bytes(), seen * source.line_bytes(), out.width * NARROWEST];
        for lines in row_chunks(rec, out.height, &each) {
            let seen = source.seen(lines.start * step..(lines.end - 1) * step + side);
            let pixels = lines.len() * out.width;
            let kernel = convolution_kernel!(ConvolutionUniform, self, source, seen, out, lines, options, {
                pitch: (source.width * source.channels()) as u32,
                terms: terms_of(side * source.channels()),
                tile_rows,
                vectors,
            });
            let groups = [pixels.div_ceil(tile_rows as usize), layer.columns.div_ceil(tile_columns as usize), 1];
            rec.dispatch_groups(kernel, groups.map(|g| g as u32)).flops(self.flops(pixels));
        }
    }

    fn flops(&self, pixels: usize) -> u64 {
        (2 * pixels * self.layer.inner * self.layer.columns) as u64
    }
}
