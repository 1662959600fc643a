//! Feature maps, and what is done to whole ones.

use super::position::Positions;
use crate::{
    gpu::{Element, Recorder, Tensor},
    kernels::heads as kernels,
    ops::{Linear, Rows, row_chunks},
};
use std::ops::Range;

/// A feature map `[height * width, channels]` f32.
#[derive(Clone, Copy)]
pub(super) struct FeatureMap {
    pub rows: Rows,
    pub height: usize,
    pub width: usize,
}

impl FeatureMap {
    pub fn new(rows: Rows, [height, width]: [usize; 2]) -> Self {
        Self { rows, height, width }
    }

    pub fn scratch(rec: &mut Recorder, name: &str, [height, width]: [usize; 2], channels: usize) -> Self {
        Self::new(Rows::scratch(rec, name, height * width, channels, Element::F32), [height, width])
    }

    pub fn channels(&self) -> usize {
        self.rows.width
    }

    pub fn size(&self) -> [usize; 2] {
        [self.height, self.width]
    }

    /// Bytes of a line.
    pub fn line_bytes(&self) -> usize {
        self.width * self.rows.row_bytes()
    }

    /// The values of lines.
    pub fn lines(&self, lines: Range<usize>) -> Tensor {
        self.rows.part(lines.start * self.width..lines.end * self.width).tensor
    }

    /// The values of lines and few before them, as slices start at whole bindings; and the first line's index.
    pub fn seen(&self, lines: Range<usize>) -> (Tensor, u32) {
        let aligned = 256 >> self.line_bytes().trailing_zeros().min(8);
        let first = lines.start / aligned * aligned;
        (self.lines(first..lines.end.min(self.height)), first as u32)
    }

    /// The map at another size, corners on corners. Where there are `positions`, what they have for the new size is added.
    pub fn resized(&self, rec: &mut Recorder, name: &str, size: [usize; 2], positions: Option<&mut Positions>) -> Self {
        let channels = self.channels();
        let out = Self::scratch(rec, name, size, channels);
        let table = positions.map(|positions| positions.table(rec, size, channels));
        let share = self.height.div_ceil(out.height.max(1)).max(1);
        for lines in row_chunks(rec, out.height, &[out.line_bytes(), share * self.line_bytes()]) {
            let place = |line: usize| line * (self.height - 1) / (out.height - 1).max(1);
            let (source, source_first) = self.seen(place(lines.start)..place(lines.end - 1) + 2);
            let count = lines.len() * out.width * channels;
            let kernel = kernels::Resize {
                source,
                positions: table.unwrap_or(source),
                out: out.lines(lines.clone()),
                count: count as u32,
                first: lines.start as u32,
                out_width: out.width as u32,
                out_height: out.height as u32,
                channels: channels as u32,
                width: self.width as u32,
                height: self.height as u32,
                source_first,
                placed: table.is_some(),
            };
            rec.dispatch(kernel, count);
        }
        out
    }

    /// The map by a transposed convolution, `side` times as high and wide. `bias` is `[outputs]` f32.
    pub fn spread(&self, rec: &mut Recorder, name: &str, side: usize, layer: &Linear, bias: Tensor) -> Self {
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
