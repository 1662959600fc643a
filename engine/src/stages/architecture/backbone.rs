//! The part of a network that turns pictures into tokens, as its backbone needs to know it.

use crate::ops::Ffn;
use serde::{Deserialize, Serialize};

/// The sizes and switches of a transformer over all views. Blocks count from 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BackboneArchitecture {
    /// What the names of its parameters begin with.
    pub root: String,
    /// D, channels of a token.
    pub width: usize,
    /// Blocks; all of them run.
    pub depth: usize,
    /// Attention heads of a block.
    pub heads: usize,
    /// Feed-forward network of the blocks.
    pub ffn: Ffn,
    /// The hidden channels of that (for SwiGLU those of `gate` alone).
    pub ffn_hidden: usize,
    /// Side of a patch in pixels.
    pub patch: usize,
    /// Side M of the learned M x M grid of position embeddings.
    pub position_grid: usize,
    /// First block that may be global; camera tokens are inserted before it. `depth` or more for none: then views do not see each
    /// other, and there are no camera tokens.
    pub alt_start: usize,
    /// First block with LayerNorm on queries and keys; `depth` or more for none.
    pub qk_norm_start: usize,
    /// First block with rotary position embedding; `depth` or more for none.
    pub rope_start: usize,
    /// Blocks whose output is a feature, ascending.
    pub out_layers: Vec<usize>,
    /// Added to the variance by the last norm; the norms of blocks add 1e-6.
    pub final_eps: f32,
    /// The encoder of known cameras.
    pub camera: Option<CameraEncoderArchitecture>,
}

/// The sizes of the encoder that turns known cameras into tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraEncoderArchitecture {
    /// What the names of its parameters begin with.
    pub root: String,
    /// Self-attention blocks.
    pub depth: usize,
    /// Attention heads of a block.
    pub heads: usize,
    /// Hidden channels of the blocks' feed-forward networks.
    pub hidden: usize,
    /// Hidden channels of the two-layer network that embeds a 9-dimensional pose.
    pub pose_hidden: usize,
}

impl BackboneArchitecture {
    /// Channels of one attention head.
    pub fn head_dim(&self) -> usize {
        self.width / self.heads
    }

    /// Whether views see each other and are told apart.
    pub fn alternates(&self) -> bool {
        self.alt_start < self.depth
    }

    /// Whether some block rotates queries and keys.
    pub fn rotates(&self) -> bool {
        self.rope_start < self.depth
    }

    /// Whether block `block` attends over the tokens of all views at once.
    pub fn is_global(&self, block: usize) -> bool {
        block >= self.alt_start && block % 2 == 1
    }
}
