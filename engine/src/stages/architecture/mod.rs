mod backbone;
mod depth;

pub use backbone::{BackboneArchitecture, CameraArchitecture, Family};
pub use depth::{DEPTH_MODELS, DepthArchitecture};

use super::Stages;
use crate::{
    Error, Result,
    gpu::Limits,
    ops::{Arithmetic, Ffn, ParameterLayout},
};
use serde::{Deserialize, Serialize};

/// Backbones with Depth Anything 3's out layers; only `vitg` has released weights.
pub const VARIANTS: [&str; 4] = ["vits", "vitb", "vitl", "vitg"];

/// The reference's smaller recipes.
pub const RECIPES: [&str; 3] = ["da3s", "da3b", "da3l"];

/// The paper's decoder on VGGT, without released weights.
pub const VGGT: &str = "vggt";

/// VGGT with `embedding` blocks before its pairs: all blocks, and the last of `pairs`.
pub(super) fn vggt_blocks([embedding, all]: [usize; 2], pairs: &[usize]) -> (usize, Vec<usize>) {
    (embedding + 2 * all, pairs.iter().map(|pair| embedding + 2 * pair + 1).collect())
}

/// Keeps products of a few dimensions within 64 bits.
pub(crate) const MAX_SIZE: usize = 1 << 16;
pub(crate) const MAX_DEPTH: usize = 256;
const MAX_SH_DEGREE: usize = 3;

/// Hyperparameters. [`BackboneArchitecture`] describes the fields that both have.
///
/// Source: ZipSplat, section 3 and appendix A; Depth Anything 3.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    pub name: String,
    #[serde(default, skip_serializing_if = "Family::is_da3")]
    pub family: Family,
    pub width: usize,
    pub depth: usize,
    pub heads: usize,
    pub ffn: Ffn,
    pub ffn_hidden: usize,
    #[serde(rename = "patch")]
    pub patch_size: usize,
    pub position_grid: usize,
    pub alt_start: usize,
    pub qk_norm_start: usize,
    pub rope_start: usize,
    pub out_layers: Vec<usize>,
    pub camera_depth: usize,
    pub camera_heads: usize,
    pub camera_hidden: usize,
    pub camera_pose_hidden: usize,
    pub fusion_heads: usize,
    pub fusion_hidden: usize,
    pub color_width: usize,
    pub color_heads: usize,
    pub color_hidden: usize,
    pub head_hidden: usize,
    pub gaussians_per_token: usize,
    /// At most 3.
    pub sh_degree: usize,
}

impl Architecture {
    /// Returns the paper's network at another width and depth.
    pub fn new(name: &str, width: usize, depth: usize, alt_start: usize, out_layers: &[usize]) -> Self {
        let (heads, color_width) = ((width / 64).max(1), 128);
        Self {
            name: name.into(),
            family: Family::Da3,
            width,
            depth,
            heads,
            ffn: Ffn::Gelu,
            ffn_hidden: 4 * width,
            patch_size: 14,
            position_grid: 37,
            alt_start,
            qk_norm_start: alt_start,
            rope_start: alt_start,
            out_layers: out_layers.into(),
            camera_depth: 4,
            camera_heads: 16,
            camera_hidden: 4 * width,
            camera_pose_hidden: width / 2,
            fusion_heads: heads,
            fusion_hidden: 4 * width,
            color_width,
            color_heads: color_width / 64,
            color_hidden: color_width,
            head_hidden: 2 * (width + color_width),
            gaussians_per_token: 32,
            sh_degree: 1,
        }
    }

    /// As [`DepthArchitecture::vggt`], with the paper's decoder, without known cameras.
    pub fn vggt(name: &str, width: usize, [embedding, pairs]: [usize; 2], out_pairs: &[usize]) -> Self {
        let (depth, out_layers) = vggt_blocks([embedding, pairs], out_pairs);
        let like = Self::new(name, width, depth, embedding, &out_layers);
        let [camera_depth, camera_heads, camera_hidden, camera_pose_hidden] = [0; 4];
        Self { family: Family::Vggt, camera_depth, camera_heads, camera_hidden, camera_pose_hidden, ..like }
    }

    pub fn takes_cameras(&self) -> bool {
        self.family.is_da3()
    }

    /// Returns one of [`VARIANTS`] or [`RECIPES`], or [`VGGT`], else [`Error::Argument`].
    pub fn named(variant: &str) -> Result<Self> {
        Ok(match variant {
            "vits" => Self::new("vits", 384, 12, 4, &[5, 7, 9, 11]),
            "vitb" => Self::new("vitb", 768, 12, 4, &[5, 7, 9, 11]),
            "vitl" => Self::new("vitl", 1024, 24, 8, &[11, 15, 19, 23]),
            "vitg" => {
                let gelu = Self::new("vitg", 1536, 40, 13, &[19, 29, 39]);
                Self { ffn: Ffn::SwiGlu, ffn_hidden: 4096, ..gelu }
            }
            "da3s" => Self::new("da3s", 384, 12, 5, &[5, 7, 11]),
            "da3b" => Self::new("da3b", 768, 12, 4, &[5, 8, 11]),
            "da3l" => Self::new("da3l", 1024, 24, 8, &[11, 17, 23]),
            VGGT => Self::vggt(VGGT, 1024, [24, 24], &[11, 17, 23]),
            _ => {
                let expected = format!("one of {}", [&VARIANTS[..], &RECIPES, &[VGGT]].concat().join(", "));
                return Err(Error::argument("variant", variant, expected));
            }
        })
    }

    pub fn backbone(&self) -> BackboneArchitecture {
        BackboneArchitecture {
            family: self.family,
            root: if self.family.is_da3() { "backbone.backbone" } else { "backbone.aggregator" }.into(),
            width: self.width,
            depth: self.depth,
            heads: self.heads,
            ffn: self.ffn,
            ffn_hidden: self.ffn_hidden,
            patch_size: self.patch_size,
            position_grid: self.position_grid,
            alt_start: self.alt_start,
            qk_norm_start: self.qk_norm_start,
            rope_start: self.rope_start,
            out_layers: self.out_layers.clone(),
            final_eps: 1e-6,
            camera: self.takes_cameras().then(|| CameraArchitecture {
                root: "backbone.cam_enc".into(),
                depth: self.camera_depth,
                heads: self.camera_heads,
                hidden: self.camera_hidden,
                pose_hidden: self.camera_pose_hidden,
            }),
        }
    }

    /// Values per Gaussian: mean 3, scale 3, quaternion 4, opacity 1, 3 per SH coefficient.
    pub fn gaussian_width(&self) -> usize {
        11 + 3 * (self.sh_degree + 1).pow(2)
    }

    /// Validates the sizes; [`Error::Argument`] names the invalid field.
    pub fn validate(&self) -> Result<()> {
        let name = &self.name;
        self.backbone().validate(name, 8)?;
        for (field, found, of, max) in [
            ("fusion_heads", self.fusion_heads, 1, MAX_SIZE),
            ("fusion_hidden", self.fusion_hidden, 8, MAX_SIZE),
            ("color_width", self.color_width, 8, MAX_SIZE),
            ("color_heads", self.color_heads, 1, MAX_SIZE),
            ("color_hidden", self.color_hidden, 8, MAX_SIZE),
            ("head_hidden", self.head_hidden, 8, MAX_SIZE),
            ("gaussians_per_token", self.gaussians_per_token, 1, 1024),
        ] {
            expect_size(name, field, found, of, max)?;
        }
        expect_heads(name, "fusion_heads", self.fusion_heads, self.width)?;
        expect_heads(name, "color_heads", self.color_heads, self.color_width)?;
        expect(name, self.alt_start < self.depth, "alt_start", self.alt_start, format!("below {}", self.depth))?;
        expect(name, self.sh_degree <= MAX_SH_DEGREE, "sh_degree", self.sh_degree, format!("0 to {MAX_SH_DEGREE}"))?;
        let ascending = self.out_layers.is_sorted_by(|a, b| a < b);
        let inside = self.out_layers.last().is_some_and(|&last| last < self.depth);
        let found = format!("{:?}", self.out_layers);
        expect(name, ascending && inside, "out_layers", found, format!("ascending blocks below {}", self.depth))
    }

    pub fn parameter_count(&self) -> usize {
        parameter_count(&self.parameters())
    }

    pub fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        declared(|p| Stages::new(p, self))
    }
}

/// Number of values in all parameters.
pub(crate) fn parameter_count(parameters: &[(String, Vec<usize>)]) -> usize {
    parameters.iter().map(|(_, shape)| shape.iter().product::<usize>()).sum()
}

fn declared<S>(stages: impl FnOnce(&mut ParameterLayout) -> S) -> Vec<(String, Vec<usize>)> {
    let mut declared = ParameterLayout::new(&Limits::default(), Arithmetic::EXACT);
    stages(&mut declared);
    declared.names_and_shapes()
}

/// Rejects a field of the network `name`.
fn expect(name: &str, holds: bool, field: &str, found: impl ToString, expected: impl Into<String>) -> Result<()> {
    if holds { Ok(()) } else { Err(Error::argument(format!("{field} of {name}"), found, expected)) }
}

fn expect_size(name: &str, field: &str, found: usize, of: usize, max: usize) -> Result<()> {
    let expected = if of == 1 { format!("1 to {max}") } else { format!("a multiple of {of} up to {max}") };
    expect(name, (1..=max).contains(&found) && found.is_multiple_of(of), field, found, expected)
}

fn expect_heads(name: &str, field: &str, found: usize, width: usize) -> Result<()> {
    let fits = width.is_multiple_of(found) && (width / found).is_multiple_of(4);
    expect(name, fits, field, found, format!("a divisor of the width {width} into heads of whole quads"))
}
