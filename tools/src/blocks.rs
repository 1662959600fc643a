use crate::{options::Size, table::counted};
use clap::Args;
use serde_json::{Value, json};
use zipsplat::{
    Result,
    reconstruct::{Block, BlockLayout, BlockOptions, MAX_VIEWS, Model, ReconstructOptions, Seam, Shape},
    types::{Camera, Pose},
};

/// Relative error of a seam worth a warning.
const APART: f64 = 0.25;

#[derive(Args, Clone, Copy, Debug)]
pub struct BlockArgs {
    /// Most views of one pass of the network. More are split into overlapping blocks, by the
    /// cameras' positions or by order, and joined in one world [default: as many as the device's
    /// memory holds, at most 192]
    #[arg(long, value_name = "N")]
    pub block_size: Option<usize>,
    /// Views that neighboring blocks share; without cameras they join the blocks [default: a
    /// quarter of the block]
    #[arg(long, value_name = "N")]
    pub block_overlap: Option<usize>,
}

impl BlockArgs {
    pub fn options(self) -> BlockOptions {
        BlockOptions { size: self.block_size, overlap: self.block_overlap }
    }

    /// Checks the blocks of `views` views as far as possible without the device.
    pub fn check(self, views: usize, shape: impl Fn(usize) -> Result<Shape>) -> Result<()> {
        BlockLayout::checked(views, self.block_size.unwrap_or(MAX_VIEWS), self.block_overlap, shape).map(drop)
    }

    /// Chooses blocks as [`BlockLayout::blocks`] and sets those of `request`.
    pub fn choose(
        self,
        model: &Model,
        views: usize,
        size: Size,
        request: &mut ReconstructOptions,
        scale: impl Fn(&[Camera], &Pose) -> Result<f64>,
    ) -> Result<Vec<Block>> {
        request.blocks = self.options();
        let layout = model.block_layout(views, [size.0, size.1], request)?;
        layout.blocks(request.cameras.as_deref(), request.scene_scale.unwrap_or(1.0), scale)
    }
}

/// `None` for one block.
pub fn plan_summary(layout: &BlockLayout) -> Option<String> {
    let BlockLayout { count, size, overlap, .. } = layout;
    (*count > 1).then(|| format!("{count} blocks of {}, {overlap} shared by neighbors", counted(*size, "view")))
}

/// `None` for one block.
pub fn summary(blocks: &[Block], seams: &[Seam]) -> Option<String> {
    let fewest = seams.iter().map(|seam| seam.shared_patches).min()?;
    let size = counted(blocks[0].views.len(), "view");
    let error = worst(seams).map(|(_, error)| format!(" and differ there by {:.1} % or less", 100.0 * error));
    let error = error.unwrap_or_default();
    Some(format!("{} blocks of {size}; neighbors share {fewest} patches or more{error}", blocks.len()))
}

/// A warning about a seam whose sides differ.
pub fn doubt(seams: &[Seam]) -> Option<String> {
    let (seam, error) = worst(seams).filter(|(_, error)| *error > APART)?;
    Some(format!(
        "block {} of the views differs by {:.0} % of its distance from those before it: a larger --block-overlap \
         or known cameras join blocks better",
        seam + 2,
        100.0 * error
    ))
}

pub fn as_json(blocks: &[Block], seams: &[Seam]) -> Value {
    let block = |(i, block): (usize, &Block)| {
        let seam = i.checked_sub(1).map(|i| seams[i]);
        json!({
            "views": block.views, "scene_scale": block.scene_scale, "scale": seam.map(|seam| seam.scale),
            "shared_patches": seam.map(|seam| seam.shared_patches), "seam_error": seam.map(|seam| seam.error),
        })
    };
    if seams.is_empty() { Value::Null } else { blocks.iter().enumerate().map(block).collect() }
}

fn worst(seams: &[Seam]) -> Option<(usize, f64)> {
    let errors = seams.iter().enumerate().filter_map(|(i, seam)| Some((i, seam.error?)));
    errors.max_by(|a, b| a.1.total_cmp(&b.1))
}
