//! Heads of Depth Anything 3 and VGGT, view by view.
//!
//! Sources: Depth Anything 3; VGGT; Ranftl et al. 2021, Vision Transformers for Dense Prediction.

mod camera;
mod convolution;
mod dpt;
mod fusion;
mod levels;
mod map;
mod pose;
mod position;
mod rays;
mod tail;

pub use camera::CameraTensors;
pub use convolution::{Convolution, ConvolutionOptions};
pub use dpt::{DEPTH_OFFSET, GAUSSIAN_VALUES, ViewTensors};
pub use position::position_table;

use super::{DepthArchitecture, DepthFeatures, POSE_VALUES, ViewGrid};
use crate::{
    Result,
    gpu::{Recorder, Run, Tensor},
    ops::{ParameterLayout, Parameters},
};
use camera::CameraDecoder;
use dpt::{Dpt, PICTURE};
use pose::PoseHead;
use position::Positions;

pub struct DepthHeads {
    dpt: Dpt,
    points: Option<Dpt>,
    camera: Option<CameraDecoder>,
    pose: Option<PoseHead>,
    gaussians: Option<Dpt>,
}

pub struct HeadTensors {
    pub views: Vec<ViewTensors>,
    /// `[height, width, 4]` f32 with a point head: encoded world point, log (confidence - 1).
    pub points: Vec<Tensor>,
    /// With a Gaussian head.
    pub gaussians: Vec<GaussianTensors>,
    /// Of joint views.
    pub cameras: Option<CameraTensors>,
    positions: Positions,
}

#[derive(Clone, Copy, Debug)]
pub struct GaussianTensors {
    /// `[height, width, 4]` f32: the normalized image.
    pub picture: Tensor,
    /// `[height, width, GAUSSIAN_VALUES]`.
    pub values: Tensor,
}

impl DepthHeads {
    pub fn new(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        Self {
            dpt: Dpt::new(p, a),
            points: a.points.then(|| Dpt::points(p, a)),
            camera: (a.multi_view() && a.camera_head.is_none()).then(|| CameraDecoder::new(p, a.feature_width())),
            pose: a.camera_head.as_ref().map(|head| PoseHead::new(p, head, a.feature_width())),
            gaussians: a.gaussians.then(|| Dpt::gaussians(p, a)),
        }
    }

    /// View by view, to bound scratch.
    pub fn record(&self, rec: &mut Recorder, features: &DepthFeatures, grid: ViewGrid) -> HeadTensors {
        let mut positions = Positions::new(grid);
        let cameras = rec.scope("camera", |rec| match (&self.camera, &self.pose, features.cameras) {
            (Some(decoder), _, Some(tokens)) => Some(decoder.record(rec, tokens)),
            (_, Some(head), Some(tokens)) => Some(head.record(rec, tokens)),
            _ => None,
        });
        let patches = grid.patches();
        let (mut views, mut points, mut gaussians) = (Vec::new(), Vec::new(), Vec::new());
        for first in (0..grid.views).map(|view| view * patches) {
            let layers: Vec<_> = features.layers.iter().map(|layer| layer.part(first..first + patches)).collect();
            views.push(self.dpt.record(rec, &layers, grid, &mut positions, None));
            if let Some(head) = &self.points {
                points.push(rec.scope("points", |rec| head.record(rec, &layers, grid, &mut positions, None).depth));
            }
            if let Some(head) = &self.gaussians {
                gaussians.push(rec.scope("gaussians", |rec| {
                    let picture = rec.input::<f32>("picture", PICTURE * grid.values() / (3 * grid.views));
                    let values = head.record(rec, &layers, grid, &mut positions, Some(picture)).depth;
                    GaussianTensors { picture, values }
                }));
            }
        }
        HeadTensors { views, points, gaussians, cameras, positions }
    }
}

impl HeadTensors {
    /// Writes positions, initial poses and, for Gaussians, normalized `images` `[views, 3,
    /// pixels]`.
    pub fn write(&self, run: &mut Run, images: &[f32], parameters: &Parameters) -> Result<()> {
        if let Some(CameraTensors::Iterated { initial, empty, .. }) = self.cameras {
            let padded = |i: usize| parameters[empty].get(i % POSE_VALUES).copied().unwrap_or(0.0);
            run.write(initial, &(0..self.views.len() * POSE_VALUES).map(padded).collect::<Vec<_>>())?;
        }
        for (view, planes) in self.gaussians.iter().zip(images.chunks(images.len() / self.views.len())) {
            let area = planes.len() / 3;
            let pixel = |i: usize| [planes[i], planes[area + i], planes[2 * area + i], 0.0];
            run.write(view.picture, &(0..area).map(pixel).collect::<Vec<_>>())?;
        }
        self.positions.write(run)
    }
}
