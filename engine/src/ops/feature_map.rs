use super::{Rows, rows::aligned_rows};
use crate::gpu::{Element, Recorder, Tensor};
use std::ops::Range;

/// A feature map `[height * width, channels]` f32.
#[derive(Clone, Copy)]
pub struct FeatureMap {
    /// Pixels in raster order.
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

    pub fn line_bytes(&self) -> usize {
        self.width * self.rows.row_bytes()
    }

    /// The first line must be slice-aligned.
    pub fn lines(&self, lines: Range<usize>) -> Tensor {
        self.rows.part(lines.start * self.width..lines.end * self.width).tensor
    }

    /// Clips lines to the map and aligns them; also returns the first's index.
    pub fn seen(&self, lines: Range<usize>) -> (Tensor, u32) {
        let aligned = aligned_rows(self.line_bytes());
        let first = lines.start / aligned * aligned;
        (self.lines(first..lines.end.min(self.height)), first as u32)
    }
}
