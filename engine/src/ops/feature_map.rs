use super::{Rows, rows::aligned_rows};
use crate::gpu::{Element, Recorder, Tensor};
use std::ops::Range;

/// A feature map `[height * width, channels]` f32.
#[derive(Clone, Copy)]
pub struct FeatureMap {
    /// Pixels in raster order.
    pub rows: Rows,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
}

impl FeatureMap {
    /// Wraps rows.
    pub fn new(rows: Rows, [height, width]: [usize; 2]) -> Self {
        Self { rows, height, width }
    }

    /// Allocates scratch memory.
    pub fn scratch(rec: &mut Recorder, name: &str, [height, width]: [usize; 2], channels: usize) -> Self {
        Self::new(Rows::scratch(rec, name, height * width, channels, Element::F32), [height, width])
    }

    /// Returns the channels.
    pub fn channels(&self) -> usize {
        self.rows.width
    }

    /// Height and width.
    pub fn size(&self) -> [usize; 2] {
        [self.height, self.width]
    }

    /// Bytes per line.
    pub fn line_bytes(&self) -> usize {
        self.width * self.rows.row_bytes()
    }

    /// Returns lines; the first must be slice-aligned.
    pub fn lines(&self, lines: Range<usize>) -> Tensor {
        self.rows.part(lines.start * self.width..lines.end * self.width).tensor
    }

    /// Returns lines, clipped to the map and aligned, and the index of the first.
    pub fn seen(&self, lines: Range<usize>) -> (Tensor, u32) {
        let aligned = aligned_rows(self.line_bytes());
        let first = lines.start / aligned * aligned;
        (self.lines(first..lines.end.min(self.height)), first as u32)
    }
}
