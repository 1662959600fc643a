//! Feature maps of convolutions.

use super::{Rows, rows::aligned_rows};
use crate::gpu::{Element, Recorder, Tensor};
use std::ops::Range;

/// A feature map `[height * width, channels]` f32, one row per pixel.
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
    /// Wraps rows as a map.
    pub fn new(rows: Rows, [height, width]: [usize; 2]) -> Self {
        Self { rows, height, width }
    }

    /// Allocates a map in scratch memory.
    pub fn scratch(rec: &mut Recorder, name: &str, [height, width]: [usize; 2], channels: usize) -> Self {
        Self::new(Rows::scratch(rec, name, height * width, channels, Element::F32), [height, width])
    }

    /// Returns the channels.
    pub fn channels(&self) -> usize {
        self.rows.width
    }

    /// Returns the height and width.
    pub fn size(&self) -> [usize; 2] {
        [self.height, self.width]
    }

    /// Returns the bytes of one image line.
    pub fn line_bytes(&self) -> usize {
        self.width * self.rows.row_bytes()
    }

    /// Returns the values of image lines. The first must start at a valid slice offset.
    pub fn lines(&self, lines: Range<usize>) -> Tensor {
        self.rows.part(lines.start * self.width..lines.end * self.width).tensor
    }

    /// Returns the values of image lines and the index of their first. The range is clipped to the
    /// map and its start aligned for slicing.
    pub fn seen(&self, lines: Range<usize>) -> (Tensor, u32) {
        let aligned = aligned_rows(self.line_bytes());
        let first = lines.start / aligned * aligned;
        (self.lines(first..lines.end.min(self.height)), first as u32)
    }
}
