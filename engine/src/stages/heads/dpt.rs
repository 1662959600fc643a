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
    ops::{ParameterLayout, Rows},
    stages::{DepthArchitecture, Family, ViewGrid},
};

pub(super) struct Dpt {
    levels: Levels,
    fusion: Fusion,
    neck: Convolution,
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
        match a.backbone.family {
            Family::Da3 => Self::of_da3(p, a),
            Family::Vggt => Self::of_vggt(p, a, ["depth_head", "depth"], 2),
        }
    }

    pub fn points(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        Self::of_vggt(p, a, ["point_head", "point"], 4)
    }

    fn of_vggt(p: &mut ParameterLayout, a: &DepthArchitecture, [root, tap]: [&'static str; 2], outputs: usize) -> Self {
        let f = a.features;
        let name = |part: &str| format!("{root}.scratch.{part}");
        Self {
            levels: Levels::new(p, a, root, true, true),
            fusion: Fusion::new(p, root, "", f, true),
            neck: Convolution::new(p, &name("output_conv1"), [f, f / 2], 3),
            depth: Tail::new(p, &name("output_conv2"), f / 2, outputs),
            rays: None,
            sky: None,
            placed: true,
            tap,
        }
    }

    fn of_da3(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        let (root, f, multi) = ("model.head", a.features, a.multi_view());
        let name = |part: &str| format!("{root}.scratch.{part}");
        let tail = |p: &mut ParameterLayout, part: &str, outputs| Tail::new(p, &name(part), f / 2, outputs);
        Self {
            levels: Levels::new(p, a, root, multi, multi),
            fusion: Fusion::new(p, root, "", f, false),
            neck: Convolution::new(p, &name("output_conv1"), [f, f / 2], 3),
            depth: tail(p, "output_conv2", if multi { 2 } else { 1 }),
            rays: multi.then(|| RayHead::new(p, root, f)),
            sky: (!multi).then(|| tail(p, "sky_output_conv2", 1)),
            placed: multi,
            tap: "head",
        }
    }

    pub fn record(
        &self,
        rec: &mut Recorder,
        features: &[Rows],
        grid: ViewGrid,
        positions: &mut Positions,
    ) -> ViewTensors {
        let tap = self.tap;
        let size = [grid.rows, grid.columns];
        let levels = rec.scope("levels", |rec| self.levels.record(rec, tap, features, size, positions));
        let (depth, sky) = rec.scope("depth", |rec| {
            let fused = self.fusion.record(rec, tap, &levels);
            let neck = self.neck.record(rec, "neck", fused, ConvolutionOptions::default());
            rec.observe(&format!("{tap}/neck"), neck.rows.tensor);
            let full = size.map(|count| count * grid.patch_size);
            let up = neck.resized(rec, "up", full, self.placed.then_some(&mut *positions));
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
