use super::row_chunks;
use crate::gpu::Recorder;
use std::ops::Range;

/// Key pooling over groups of neighboring patches.
///
/// A group of n patches adds log n to its score (proportional attention). Sources: Token Merging,
/// Bolya et al. 2023; FastVGGT, Shen et al. 2025. Keys of the own view: AVGGT, 2025.
#[derive(Clone, Copy, Debug)]
pub struct Pool {
    /// Group side in patches.
    pub side: usize,
    /// Patch rows and columns per view.
    pub grid: [usize; 2],
    /// Unpooled leading tokens.
    pub leading: usize,
    /// Whether a view's queries see its own tokens instead of its groups.
    pub own: bool,
    /// Whether the first view is unpooled.
    pub first: bool,
}

impl Pool {
    pub const MAX_SIDE: usize = 4;

    /// Per view.
    pub fn tokens(&self) -> usize {
        self.leading + self.grid.iter().product::<usize>()
    }

    /// Per pooled view.
    pub fn keys(&self) -> usize {
        self.leading + self.grid.iter().map(|side| side.div_ceil(self.side)).product::<usize>()
    }

    /// Of `tokens` of leading views.
    pub fn keys_of(&self, tokens: usize) -> usize {
        let views = tokens / self.tokens();
        let unpooled = usize::from(self.first).min(views);
        unpooled * self.tokens() + (views - unpooled) * self.keys()
    }

    /// Whole views.
    pub(super) fn chunks(
        pool: Option<Self>,
        rec: &Recorder,
        rows: usize,
        widths: &[usize],
    ) -> impl Iterator<Item = Range<usize>> + use<> {
        let unit = pool.map_or(1, |pool| pool.tokens());
        let widths: Vec<usize> = widths.iter().map(|bytes| bytes * unit).collect();
        row_chunks(rec, rows / unit, &widths).map(move |part| part.start * unit..part.end * unit)
    }
}
