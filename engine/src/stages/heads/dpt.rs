use super::{
    convolution::{Convolution, ConvolutionOptions},
    fusion::Fusion,
    levels::Levels,
    position::Positions,
    rays::RayHead,
    tail::Tail,
};
use crate::{
    gpu::{Recorder, Tensor},
    ops::{FeatureMap, ParameterLayout, Rows, add},
    stages::{DepthArchitecture, Family, ViewGrid},
};

/// Pixel offset 2, scale 3, quaternion 4, SH 27, depth offset, opacity.
pub const GAUSSIAN_VALUES: usize = 38;
/// Place of the depth offset, in units of depth.
pub const DEPTH_OFFSET: usize = 36;

pub(super) const PICTURE: usize = 4;

pub(super) struct Dpt {
    levels: Levels,
    fusion: Fusion,
    neck: Convolution,
    /// Adds features of the picture.
    merger: Option<[Convolution; 3]>,
    depth: Tail,
    rays: Option<RayHead>,
    sky: Option<Tail>,
    placed: bool,
    tap: &'static str,
}

#[derive(Clone, Copy, Debug)]
pub struct ViewTensors {
    /// `[height, width, 2]` f32: log depth, log (confidence - 1); depth alone for separate views.
    pub depth: Tensor,
    /// `[8 rows, 8 columns, 7]` f32: direction, origin, log (confidence - 1).
    pub rays: Option<Tensor>,
    /// `[height, width]` f32, before ReLU.
    pub sky: Option<Tensor>,
}

impl Dpt {
    pub fn new(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        if a.backbone.family == Family::Vggt {
            return Self::of(p, a, ["depth_head", "depth"], [true; 3], 2);
        }
        let (root, f, multi) = ("model.head", a.features, a.multi_view());
        let head = Self::of(p, a, [root, "head"], [multi, multi, false], if multi { 2 } else { 1 });
        let rays = multi.then(|| RayHead::new(p, root, f));
        let sky = (!multi).then(|| Tail::new(p, &format!("{root}.scratch.sky_output_conv2"), f / 2, 1));
        Self { rays, sky, ..head }
    }

    pub fn points(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        Self::of(p, a, ["point_head", "point"], [true; 3], 4)
    }

    /// Returns the Gaussian head, whose `depth` has [`GAUSSIAN_VALUES`].
    pub fn gaussians(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        let (root, f) = ("model.gs_head", a.features);
        let head = Self::of(p, a, [root, "gs"], [false, true, false], GAUSSIAN_VALUES);
        let layers = [(0, [3, f / 8]), (2, [f / 8, f / 4]), (4, [f / 4, f / 2])];
        let layer = |(i, channels)| Convolution::new(p, &format!("{root}.images_merger.{i}"), channels, 3);
        Self { merger: Some(layers.map(layer)), ..head }
    }

    fn of(
        p: &mut ParameterLayout,
        a: &DepthArchitecture,
        [root, tap]: [&'static str; 2],
        [normed, placed, rectified]: [bool; 3],
        outputs: usize,
    ) -> Self {
        let f = a.features;
        let name = |part: &str| format!("{root}.scratch.{part}");
        Self {
            levels: Levels::new(p, a, root, normed, placed),
            fusion: Fusion::new(p, root, "", f, rectified),
            neck: Convolution::new(p, &name("output_conv1"), [f, f / 2], 3),
            merger: None,
            depth: Tail::new(p, &name("output_conv2"), f / 2, outputs),
            rays: None,
            sky: None,
            placed,
            tap,
        }
    }

    /// `picture` is the Gaussian head's input `[height, width, PICTURE]`.
    pub fn record(
        &self,
        rec: &mut Recorder,
        features: &[Rows],
        grid: ViewGrid,
        positions: &mut Positions,
        picture: Option<Tensor>,
    ) -> ViewTensors {
        let tap = self.tap;
        let size = [grid.rows, grid.columns];
        let levels = rec.scope("levels", |rec| self.levels.record(rec, tap, features, size, positions));
        let (depth, sky) = rec.scope("depth", |rec| {
            let fused = self.fusion.record(rec, tap, &levels);
            let neck = self.neck.record(rec, "neck", fused, ConvolutionOptions::default());
            rec.observe(&format!("{tap}/neck"), neck.rows.tensor);
            let full = size.map(|count| count * grid.patch_size);
            let up = match self.merger.as_ref().zip(picture) {
                Some((merger, picture)) => {
                    let picture = FeatureMap::new(Rows::new(picture, full[0] * full[1], PICTURE), full);
                    let gelu = ConvolutionOptions { gelu: true, ..ConvolutionOptions::default() };
                    let merged = merger.iter().fold(picture, |map, layer| layer.record(rec, "merged", map, gelu));
                    rec.observe(&format!("{tap}/merger"), merged.rows.tensor);
                    let up = neck.resized(rec, "up", full, None);
                    add(rec, up.rows, merged.rows);
                    up.resized(rec, "placed", full, Some(&mut *positions))
                }
                None => neck.resized(rec, "up", full, self.placed.then_some(&mut *positions)),
            };
            rec.observe(&format!("{tap}/up"), up.rows.tensor);
            let depth = self.depth.record(rec, &format!("{tap}/logits"), up);
            let sky = self.sky.as_ref().map(|tail| tail.record(rec, "head/logits_sky", up));
            (depth, sky)
        });
        let rays = self.rays.as_ref();
        let rays = rays.map(|head| rec.scope("rays", |rec| head.record(rec, &levels, positions)));
        ViewTensors { depth, rays, sky }
    }
}
