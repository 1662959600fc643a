use super::{
    BackboneArchitecture, CameraArchitecture, Family, MAX_SIZE, declared, expect, expect_size, parameter_count,
    vggt_blocks,
};
use crate::{Error, Result, ops::Ffn, stages::DepthStages, types::Fitting};
use serde::{Deserialize, Serialize};

/// Released networks.
pub const DEPTH_MODELS: [&str; 7] =
    ["da3-small", "da3-base", "da3-large", "da3-giant", "da3mono-large", "da3metric-large", "vggt-1b"];

/// Hyperparameters of Depth Anything 3 or VGGT.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthArchitecture {
    pub name: String,
    /// Transformer with four out layers; alternating attention implies joint views and cameras.
    pub backbone: BackboneArchitecture,
    pub features: usize,
    /// Per level.
    pub channels: [usize; 4],
    pub gaussians: bool,
    /// Head of world points.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub points: bool,
    /// VGGT's camera head.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_head: Option<CameraArchitecture>,
}

impl DepthArchitecture {
    /// Returns a network with default sizes; q/k norm, rotary embedding and cameras start at
    /// `alt_start`.
    pub fn new(
        name: &str,
        [width, depth, alt_start]: [usize; 3],
        ffn: Ffn,
        out_layers: [usize; 4],
        features: usize,
        channels: [usize; 4],
    ) -> Self {
        let gated = (4 * width * 2 / 3).next_multiple_of(8);
        let camera = CameraArchitecture {
            root: "model.cam_enc".into(),
            depth: 4,
            heads: 16,
            hidden: 4 * width,
            pose_hidden: width / 2,
        };
        let backbone = BackboneArchitecture {
            family: Family::Da3,
            root: "model.backbone.pretrained".into(),
            width,
            depth,
            heads: width / 64,
            ffn,
            ffn_hidden: if ffn == Ffn::Gelu { 4 * width } else { gated },
            patch_size: 14,
            position_grid: 37,
            alt_start,
            qk_norm_start: alt_start,
            rope_start: alt_start,
            out_layers: out_layers.into(),
            final_eps: 1e-5,
            camera: (alt_start < depth).then_some(camera),
        };
        let (gaussians, points, camera_head) = (false, false, None);
        Self { name: name.into(), backbone, features, channels, gaussians, points, camera_head }
    }

    /// Returns VGGT with `embedding` blocks, then pairs of blocks; `out_pairs` give features.
    pub fn vggt(
        name: &str,
        width: usize,
        [embedding, pairs]: [usize; 2],
        out_pairs: [usize; 4],
        features: usize,
        channels: [usize; 4],
    ) -> Self {
        let (depth, out_layers) = vggt_blocks([embedding, pairs], &out_pairs);
        let like = Self::new(name, [width, depth, embedding], Ffn::Gelu, out_pairs, features, channels);
        let (family, root, final_eps, camera) = (Family::Vggt, "aggregator".into(), 1e-5, None);
        let backbone = BackboneArchitecture { family, root, out_layers, final_eps, camera, ..like.backbone };
        let (depth, heads, hidden, pose_hidden) = (4, 16, 8 * width, width);
        let camera_head = Some(CameraArchitecture { root: "camera_head".into(), depth, heads, hidden, pose_hidden });
        Self { backbone, camera_head, ..like }
    }

    /// Returns one of [`DEPTH_MODELS`], else [`Error::Argument`].
    pub fn named(name: &str) -> Result<Self> {
        let large = [256, 512, 1024, 1024];
        Ok(match name {
            "da3-small" => Self::new(name, [384, 12, 4], Ffn::Gelu, [5, 7, 9, 11], 64, [48, 96, 192, 384]),
            "da3-base" => Self::new(name, [768, 12, 4], Ffn::Gelu, [5, 7, 9, 11], 128, [96, 192, 384, 768]),
            "da3-large" => Self::new(name, [1024, 24, 8], Ffn::Gelu, [11, 15, 19, 23], 256, large),
            "da3-giant" => {
                let giant = Self::new(name, [1536, 40, 13], Ffn::SwiGlu, [19, 27, 33, 39], 256, large);
                Self { gaussians: true, ..giant }
            }
            "da3mono-large" | "da3metric-large" => {
                Self::new(name, [1024, 24, 24], Ffn::Gelu, [4, 11, 17, 23], 256, large)
            }
            "vggt-1b" => Self::vggt(name, 1024, [24, 24], [4, 11, 17, 23], 256, large),
            _ => return Err(Error::argument("depth network", name, format!("one of {}", DEPTH_MODELS.join(", ")))),
        })
    }

    pub fn fitting(&self) -> Fitting {
        if self.backbone.family.is_da3() { Fitting::LongestSide } else { Fitting::Width }
    }

    /// Whether views are joint, with cameras, or separate, with sky.
    pub fn multi_view(&self) -> bool {
        self.backbone.alternates()
    }

    pub fn feature_width(&self) -> usize {
        self.backbone.width * if self.multi_view() { 2 } else { 1 }
    }

    /// As [`Architecture::validate`](super::Architecture::validate).
    pub fn validate(&self) -> Result<()> {
        let (name, b) = (&self.name, &self.backbone);
        // 16 camera heads of whole quads.
        b.validate(name, if b.family.is_da3() { 64 } else { 32 })?;
        let expected = "1 or more: the reference view is chosen by the block before";
        expect(name, b.alt_start > 0, "alt_start", b.alt_start, expected)?;
        let layers = b.out_layers.len() == 4 && b.out_layers.is_sorted() && b.out_layers[3] < b.depth;
        let found = format!("{:?}", b.out_layers);
        expect(name, layers, "out_layers", found, "four ascending blocks below the depth")?;
        let own = self.camera_head.is_some() != b.family.is_da3();
        expect(name, own, "camera_head", format!("{:?}", self.camera_head), "one for VGGT alone")?;
        let head = self.camera_head.as_ref();
        head.map_or(Ok(()), |camera| camera.validate(name, "camera_head.", self.feature_width()))?;
        expect_size(name, "features", self.features, if self.gaussians { 32 } else { 8 }, MAX_SIZE)?;
        self.channels.iter().try_for_each(|&channels| expect_size(name, "channels", channels, 4, MAX_SIZE))
    }

    pub fn parameter_count(&self) -> usize {
        parameter_count(&self.parameters())
    }

    pub fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        declared(|p| DepthStages::new(p, self))
    }
}
