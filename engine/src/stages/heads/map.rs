use super::position::Positions;
use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::heads as kernels,
    ops::{FeatureMap, Linear, row_chunks},
};

impl FeatureMap {
    /// Resizes with aligned corners, optionally adding positions.
    pub(super) fn resized(
        &self,
        rec: &mut Recorder,
        name: &str,
        size: [usize; 2],
        positions: Option<&mut Positions>,
    ) -> Self {
        let channels = self.channels();
        let out = Self::scratch(rec, name, size, channels);
        let table = positions.map(|positions| positions.table(rec, size, channels));
        let seen = self.height.div_ceil(out.height) + 1;
        for lines in row_chunks(rec, out.height, &[out.line_bytes(), seen * self.line_bytes()]) {
            let place = |line: usize| line * (self.height - 1) / (out.height - 1).max(1);
            let (source, source_first) = self.seen(place(lines.start)..place(lines.end - 1) + 2);
            let pixels = lines.len() * out.width;
            let kernel = kernels::Resize {
                source,
                positions: table.unwrap_or(source),
                out: out.lines(lines.clone()),
                pixels: pixels as u32,
                first: lines.start as u32,
                out_width: out.width as u32,
                out_height: out.height as u32,
                channels: channels as u32,
                width: self.width as u32,
                height: self.height as u32,
                source_first,
                placed: table.is_some(),
            };
            rec.dispatch_groups(kernel, pixels);
        }
        out
    }

    pub(super) fn spread(&self, rec: &mut Recorder, name: &str, side: usize, layer: &Linear, bias: Tensor) -> Self {
        let values = layer.apply(rec, "spread", self.rows, Element::F32, Default::default());
        let values = Self::new(values, self.size());
        let channels = layer.columns / (side * side);
        let out = Self::scratch(rec, name, [side * self.height, side * self.width], channels);
        for lines in row_chunks(rec, self.height, &[values.line_bytes(), side * out.line_bytes()]) {
            let count = lines.len() * self.width * layer.columns;
            let kernel = kernels::PixelShuffle {
                source: values.lines(lines.clone()),
                bias,
                out: out.lines(side * lines.start..side * lines.end),
                count: count as u32,
                width: self.width as u32,
                side: side as u32,
                channels: channels as u32,
            };
            rec.dispatch(kernel, count);
        }
        out
    }
}
