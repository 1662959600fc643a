use super::row_chunks;
use crate::{Error, Result, gpu::Recorder};
use std::ops::Range;

/// Key pooling over groups of neighboring patches.
///
/// A group of n patches adds log n to its score (proportional attention). Sources: Token Merging,
/// Bolya et al. 2023; FastVGGT, Shen et al. 2025.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pool {
    /// Group side in patches.
    pub side: usize,
    /// Patch rows and columns per view.
    pub grid: [usize; 2],
    /// Unpooled leading tokens.
    pub leading: usize,
}

impl Pool {
    pub const MAX_SIDE: usize = 4;

    pub(crate) fn of(side: usize, grid: [usize; 2], leading: usize) -> Option<Self> {
        (side > 1).then_some(Self { side, grid, leading })
    }

    /// [`Error::Argument`] outside 1..=[`Pool::MAX_SIDE`].
    pub fn check(side: usize) -> Result<()> {
        if (1..=Self::MAX_SIDE).contains(&side) {
            Ok(())
        } else {
            Err(Error::argument("pool", side, format!("1 to {}, the side of a group", Self::MAX_SIDE)))
        }
    }

    pub fn tokens(&self) -> usize {
        self.leading + self.grid.iter().product::<usize>()
    }

    pub fn keys(&self) -> usize {
        self.leading + self.grid.iter().map(|side| side.div_ceil(self.side)).product::<usize>()
    }

    pub(super) fn keys_of(pool: Option<Self>, tokens: usize) -> usize {
        pool.map_or(tokens, |pool| tokens / pool.tokens() * pool.keys())
    }

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
