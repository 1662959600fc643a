//! The stages, in the order of the data, which is the alphabet's: each records its dispatches and knows no other.

pub mod backbone;
pub mod cluster;
pub mod fuse;
pub mod gaussians;
pub mod loss;
pub mod render;

use crate::gpu::{Recorder, Tensor};

/// Shape of the input: `views` pictures of `rows` x `columns` patches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewGrid {
    /// Pictures.
    pub views: usize,
    /// Patches from top to bottom.
    pub rows: usize,
    /// Patches from left to right.
    pub columns: usize,
    /// Side of a patch in pixels.
    pub patch: usize,
}

impl ViewGrid {
    /// Patches of a view.
    pub fn patches(&self) -> usize {
        self.rows * self.columns
    }

    /// Patches of all views.
    pub fn tokens(&self) -> usize {
        self.views * self.patches()
    }

    /// Values of all pictures, three channels each.
    pub fn values(&self) -> usize {
        3 * self.tokens() * self.patch * self.patch
    }
}

/// The pictures of one plan: all of one size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameShape {
    /// Pictures.
    pub cameras: usize,
    /// Pixels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Every patch embedded by a convolution whose stride is its size: `[tokens, width]`.
fn embed_patches(rec: &mut Recorder, images: Tensor, grid: ViewGrid, linear: &crate::ops::Linear) -> Tensor {
    let values = 3 * grid.patch * grid.patch;
    let out = rec.tensor::<f32>("embedded", grid.tokens() * linear.columns);
    let (view, row) = (values * grid.patches(), linear.inner);
    let widths = [4 * view, linear.element().bytes() * grid.patches() * row, 4 * grid.patches() * linear.columns];
    for part in crate::ops::row_chunks(rec, grid.views, &widths) {
        let tokens = part.len() * grid.patches();
        let patches = rec.tensor_of(linear.element(), "patches", tokens * row);
        let kernel = crate::kernels::backbone::Patchify {
            images: images.slice::<f32>(part.start * view, part.len() * view),
            out: patches,
            views: part.len() as u32,
            height: (grid.rows * grid.patch) as u32,
            width: (grid.columns * grid.patch) as u32,
            patch_size: grid.patch as u32,
            stride: row as u32,
            output: linear.element(),
        };
        rec.dispatch(kernel, tokens * row);
        let first = part.start * grid.patches() * linear.columns;
        let out = out.slice::<f32>(first, tokens * linear.columns);
        linear.record(rec, patches, tokens, out, crate::ops::Epilogue::default());
    }
    out
}
