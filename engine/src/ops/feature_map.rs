//! Feature maps of convolutions.

use super::{Rows, rows::aligned_rows};
use crate::gpu::{Element, Recorder, Tensor};
use std::ops::Range;

/// A feature map `[height * width, channels]` f32, a row a pixel.
#[derive(Clone, Copy)]
pub struct FeatureMap {
    /// The pixels, line by line.
    pub rows: Rows,
    /// Lines.
    pub height: usize,
    /// Pixels of a line.
    pub width: usize,
}

impl FeatureMap {
    /// A map of these rows.
    pub fn new(rows: Rows, [height, width]: [usize; 2]) -> Self {
        Self { rows, height, width }
    }

    /// A map in scratch memory.
    pub fn scratch(rec: &mut Recorder, name: &str, [height, width]: [usize; 2], channels: usize) -> Self {
        Self::new(Rows::scratch(rec, name, height * width, channels, Element::F32), [height, width])
    }

    /// Values of a pixel.
    pub fn channels(&self) -> usize {
        self.rows.width
    }

    /// Height and width.
    pub fn size(&self) -> [usize; 2] {
        [self.height, self.width]
    }

    /// Bytes of a line.
    pub fn line_bytes(&self) -> usize {
        self.width * self.rows.row_bytes()
    }

    /// The values of lines; the first is one where a slice may start.
    pub fn lines(&self, lines: Range<usize>) -> Tensor {
        self.rows.part(lines.start * self.width..lines.end * self.width).tensor
    }

    /// The values of lines that are there, from one on where a slice may start; and that line's index.
    pub fn seen(&self, lines: Range<usize>) -> (Tensor, u32) {
        let aligned = aligned_rows(self.line_bytes());
        let first = lines.start / aligned * aligned;
        (self.lines(first..lines.end.min(self.height)), first as u32)
    }
}
