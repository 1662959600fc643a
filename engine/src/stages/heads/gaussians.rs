use super::{
    convolution::{Convolution, ConvolutionOptions},
    fusion::Fusion,
    levels::Levels,
    position::Positions,
    tail::Tail,
};
use crate::{
    gpu::{Recorder, Tensor},
    ops::{FeatureMap, ParameterLayout, Rows, add},
    stages::{DepthArchitecture, ViewGrid},
};

/// Pixel offset 2, scale 3, quaternion 4, SH 27, depth offset, opacity.
pub const GAUSSIAN_VALUES: usize = 38;
/// Place of the depth offset, in units of depth.
pub const DEPTH_OFFSET: usize = 36;

const PICTURE: usize = 4;

pub(super) struct GaussianHead {
    levels: Levels,
    fusion: Fusion,
    neck: Convolution,
    merger: [Convolution; 3],
    tail: Tail,
}

#[derive(Clone, Copy, Debug)]
pub struct GaussianTensors {
    /// `[height, width, 4]` f32: the normalized image.
    pub picture: Tensor,
    /// `[height, width, GAUSSIAN_VALUES]`.
    pub values: Tensor,
}

impl GaussianHead {
    pub fn new(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        let (root, f) = ("model.gs_head", a.features);
        let merged = [(0, [3, f / 8]), (2, [f / 8, f / 4]), (4, [f / 4, f / 2])];
        Self {
            levels: Levels::new(p, a, root, false, true),
            fusion: Fusion::new(p, root, "", f, false),
            neck: Convolution::new(p, &format!("{root}.scratch.output_conv1"), [f, f / 2], 3),
            merger: merged.map(|(i, channels)| Convolution::new(p, &format!("{root}.images_merger.{i}"), channels, 3)),
            tail: Tail::new(p, &format!("{root}.scratch.output_conv2"), f / 2, GAUSSIAN_VALUES),
        }
    }

    pub fn record(
        &self,
        rec: &mut Recorder,
        features: &[Rows],
        grid: ViewGrid,
        positions: &mut Positions,
    ) -> GaussianTensors {
        let size = [grid.rows, grid.columns];
        let full = size.map(|count| count * grid.patch_size);
        let pixels = full[0] * full[1];
        let picture = rec.input::<f32>("picture", PICTURE * pixels);
        let levels = self.levels.record(rec, "gs", features, size, positions);
        let fused = self.fusion.record(rec, "gs", &levels);
        let neck = self.neck.record(rec, "neck", fused, ConvolutionOptions::default());
        rec.observe("gs/neck", neck.rows.tensor);
        let mut merged = FeatureMap::new(Rows::new(picture, pixels, PICTURE), full);
        for layer in &self.merger {
            merged =
                layer.record(rec, "merged", merged, ConvolutionOptions { gelu: true, ..ConvolutionOptions::default() });
        }
        rec.observe("gs/merger", merged.rows.tensor);
        let up = neck.resized(rec, "up", full, None);
        add(rec, up.rows, merged.rows);
        let placed = up.resized(rec, "placed", full, Some(positions));
        rec.observe("gs/up", placed.rows.tensor);
        GaussianTensors { picture, values: self.tail.record(rec, "gs/logits", placed) }
    }
}
