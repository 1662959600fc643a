use crate::ops::Ffn;
use serde::{Deserialize, Serialize};

/// Transformer sizes. Blocks count from 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BackboneArchitecture {
    /// Parameter name prefix.
    pub root: String,
    /// Token channels, D.
    pub width: usize,
    /// Blocks.
    pub depth: usize,
    /// Attention heads per block.
    pub heads: usize,
    /// Feed-forward network.
    pub ffn: Ffn,
    /// Its hidden channels; for SwiGLU, those of `gate`.
    pub ffn_hidden: usize,
    /// Patch side in pixels.
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
    /// Final norm epsilon; blocks use 1e-6.
    pub final_eps: f32,
    /// Encoder of known cameras.
    pub camera: Option<CameraEncoderArchitecture>,
}

/// Camera encoder sizes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraEncoderArchitecture {
    /// Parameter name prefix.
    pub root: String,
    /// Blocks.
    pub depth: usize,
    /// Attention heads per block.
    pub heads: usize,
    /// Feed-forward channels.
    pub hidden: usize,
    /// Pose embedding channels.
    pub pose_hidden: usize,
}

impl BackboneArchitecture {
    /// Channels per attention head.
    pub fn head_dim(&self) -> usize {
        self.width / self.heads
    }

    /// Whether blocks attend across views.
    pub fn alternates(&self) -> bool {
        self.alt_start < self.depth
    }

    /// Whether blocks use rotary embedding.
    pub fn rotates(&self) -> bool {
        self.rope_start < self.depth
    }

    /// Whether a block attends across views.
    pub fn is_global(&self, block: usize) -> bool {
        block >= self.alt_start && block % 2 == 1
    }
}
