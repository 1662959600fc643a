//! Pooled keys and values: attention sees one mean in place of neighbouring patches.

use super::row_chunks;
use crate::{Error, Result, gpu::Recorder};
use std::ops::Range;

/// Groups of neighbouring patches of each view, whose keys and values are averaged.
///
/// A group of n patches weighs as much as n keys: log n is added to its score (proportional attention: Token Merging, Bolya et al.
/// 2023; for networks of many views FastVGGT, Shen et al. 2025).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pool {
    /// Patches of a group along each side, fewer at a view's right and lower border.
    pub side: usize,
    /// Rows and columns of a view's patches.
    pub grid: [usize; 2],
    /// Tokens before the patches of a view, which stay as they are.
    pub leading: usize,
}

impl Pool {
    /// The largest side of a group.
    pub const MAX_SIDE: usize = 4;

    /// Groups of `side` x `side` patches, or none where each would have one patch.
    pub(crate) fn of(side: usize, grid: [usize; 2], leading: usize) -> Option<Self> {
        (side > 1).then_some(Self { side, grid, leading })
    }

    /// Checks the side of groups that is asked for.
    ///
    /// # Errors
    /// [`Error::Argument`] where it is 0 or above [`Pool::MAX_SIDE`].
    pub fn check(side: usize) -> Result<()> {
        match (1..=Self::MAX_SIDE).contains(&side) {
            true => Ok(()),
            false => Err(Error::argument("pool", side, format!("1 to {}, the side of a group", Self::MAX_SIDE))),
        }
    }

    /// Tokens of a view.
    pub fn tokens(&self) -> usize {
        self.leading + self.grid.iter().product::<usize>()
    }

    /// Keys of a view.
    pub fn keys(&self) -> usize {
        self.leading + self.grid.iter().map(|side| side.div_ceil(self.side)).product::<usize>()
    }

    /// Keys of so many tokens, which are whole views.
    pub(super) fn keys_of(pool: Option<Self>, tokens: usize) -> usize {
        pool.map_or(tokens, |pool| tokens / pool.tokens() * pool.keys())
    }

    /// The parts of [`row_chunks`], of whole views where their keys are pooled.
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
