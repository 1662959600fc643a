use super::{MAX_DEPTH, MAX_SIZE, expect, expect_heads, expect_size};
use crate::{Result, ops::Ffn};
use serde::{Deserialize, Serialize};

/// Names, special tokens and positions of a backbone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Family {
    /// Depth Anything 3: a camera token per view, from block `alt_start` on.
    #[default]
    Da3,
    /// VGGT: a patch embedding, then from block `alt_start` on pairs of a block within and one
    /// across views, with a camera token and four registers per view.
    Vggt,
}

impl Family {
    pub(super) fn is_da3(&self) -> bool {
        *self == Self::Da3
    }
}

/// Transformer sizes. Blocks count from 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BackboneArchitecture {
    #[serde(default, skip_serializing_if = "Family::is_da3")]
    pub family: Family,
    /// Parameter name prefix.
    pub root: String,
    pub width: usize,
    pub depth: usize,
    pub heads: usize,
    pub ffn: Ffn,
    /// Hidden channels; for SwiGLU, those of `gate`.
    pub ffn_hidden: usize,
    #[serde(rename = "patch")]
    pub patch_size: usize,
    /// Side of the learned position grid.
    pub position_grid: usize,
    /// First block that may be global, where camera tokens enter; `depth` or more for separate
    /// views.
    pub alt_start: usize,
    /// First block with q/k norm; `depth` or more for none.
    pub qk_norm_start: usize,
    /// First block with rotary embedding; `depth` or more for none.
    pub rope_start: usize,
    /// Feature blocks, ascending.
    pub out_layers: Vec<usize>,
    /// Blocks use 1e-6.
    pub final_eps: f32,
    pub camera: Option<CameraArchitecture>,
}

/// Transformer over the views' camera tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraArchitecture {
    pub root: String,
    pub depth: usize,
    pub heads: usize,
    pub hidden: usize,
    pub pose_hidden: usize,
}

impl CameraArchitecture {
    pub(super) fn validate(&self, name: &str, prefix: &str, width: usize) -> Result<()> {
        for (field, found, of, max) in [
            ("depth", self.depth, 1, MAX_DEPTH),
            ("heads", self.heads, 1, MAX_SIZE),
            ("hidden", self.hidden, 8, MAX_SIZE),
            ("pose_hidden", self.pose_hidden, 8, MAX_SIZE),
        ] {
            expect_size(name, &format!("{prefix}{field}"), found, of, max)?;
        }
        expect_heads(name, &format!("{prefix}heads"), self.heads, width)
    }
}

impl BackboneArchitecture {
    pub fn head_dim(&self) -> usize {
        self.width / self.heads
    }

    pub fn alternates(&self) -> bool {
        self.alt_start < self.depth
    }

    pub fn rotates(&self) -> bool {
        self.rope_start < self.depth
    }

    pub fn is_global(&self, block: usize) -> bool {
        let first = if self.family.is_da3() { 0 } else { self.alt_start };
        block >= self.alt_start && (block - first) % 2 == 1
    }

    /// Validates the sizes of the network `name`, with a width that is a multiple of `of`.
    pub(super) fn validate(&self, name: &str, of: usize) -> Result<()> {
        // Rows of 16-bit values take whole vectors of 16 bytes.
        for (field, found, of, max) in [
            ("width", self.width, of, MAX_SIZE),
            ("depth", self.depth, 1, MAX_DEPTH),
            ("heads", self.heads, 1, MAX_SIZE),
            ("ffn_hidden", self.ffn_hidden, 8, MAX_SIZE),
            ("patch", self.patch_size, 2, 256),
            ("position_grid", self.position_grid, 1, 1024),
        ] {
            expect_size(name, field, found, of, max)?;
        }
        expect_heads(name, "heads", self.heads, self.width)?;
        self.camera.as_ref().map_or(Ok(()), |camera| camera.validate(name, "camera_", self.width))?;
        self.validate_pairs(name)
    }

    /// Features of VGGT end a pair of blocks.
    fn validate_pairs(&self, name: &str) -> Result<()> {
        let whole = self.alt_start < self.depth && self.out_layers.iter().all(|&block| self.is_global(block));
        if self.family.is_da3() || whole && (self.depth - self.alt_start).is_multiple_of(2) {
            return Ok(());
        }
        let found = format!("{:?} of {} from {}", self.out_layers, self.depth, self.alt_start);
        expect(name, false, "out_layers", found, "blocks that end pairs")
    }

    /// Whether the reference view depends on the views.
    pub fn chooses_reference(&self) -> bool {
        self.alternates() && self.family.is_da3()
    }
}
