//! Sizes of a backbone.

use crate::ops::Ffn;
use serde::{Deserialize, Serialize};

/// Sizes of a transformer over all views. Blocks count from 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BackboneArchitecture {
    /// Prefix of its parameter names.
    pub root: String,
    /// Token channels, D.
    pub width: usize,
    /// Blocks.
    pub depth: usize,
    /// Attention heads per block.
    pub heads: usize,
    /// Feed-forward network of the blocks.
    pub ffn: Ffn,
    /// Its hidden channels; with SwiGLU, those of `gate`.
    pub ffn_hidden: usize,
    /// Patch side in pixels.
    pub patch: usize,
    /// Side M of the learned M x M position embeddings.
    pub position_grid: usize,
    /// First block that may be global; camera tokens enter here. `depth` or more keeps views
    /// independent.
    pub alt_start: usize,
    /// First block with q/k norm; `depth` or more disables it.
    pub qk_norm_start: usize,
    /// First block with rotary embedding; `depth` or more disables it.
    pub rope_start: usize,
    /// Blocks with feature outputs, ascending.
    pub out_layers: Vec<usize>,
    /// Epsilon of the final norm; blocks use 1e-6.
    pub final_eps: f32,
    /// Encoder of known cameras.
    pub camera: Option<CameraEncoderArchitecture>,
}

/// Sizes of the encoder of known cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraEncoderArchitecture {
    /// Prefix of its parameter names.
    pub root: String,
    /// Blocks.
    pub depth: usize,
    /// Attention heads per block.
    pub heads: usize,
    /// Feed-forward channels.
    pub hidden: usize,
    /// Hidden channels of the pose embedding.
    pub pose_hidden: usize,
}

impl BackboneArchitecture {
    /// Channels per attention head.
    pub fn head_dim(&self) -> usize {
        self.width / self.heads
    }

    /// Whether some blocks attend across views.
    pub fn alternates(&self) -> bool {
        self.alt_start < self.depth
    }

    /// Whether some blocks use rotary embedding.
    pub fn rotates(&self) -> bool {
        self.rope_start < self.depth
    }

    /// Whether a block attends across views.
    pub fn is_global(&self, block: usize) -> bool {
        block >= self.alt_start && block % 2 == 1
    }
}
