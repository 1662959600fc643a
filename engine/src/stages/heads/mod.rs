//! Heads of Depth Anything 3, view by view.
//!
//! Source: Depth Anything 3; Ranftl et al. 2021, Vision Transformers for Dense Prediction.

mod camera;
mod convolution;
mod dpt;
mod fusion;
mod gaussians;
mod levels;
mod map;
mod position;
mod rays;
mod tail;

pub use camera::CameraTensors;
pub use convolution::{Convolution, ConvolutionOptions};
pub use dpt::ViewTensors;
pub use gaussians::{GAUSSIAN_VALUES, GaussianTensors};
pub use position::position_table;

use super::{DepthArchitecture, DepthFeatures, ViewGrid};
use crate::{
    Result,
    gpu::{Recorder, Run},
    ops::ParameterLayout,
};
use camera::CameraDecoder;
use dpt::Dpt;
use gaussians::GaussianHead;
use position::Positions;

pub struct DepthHeads {
    dpt: Dpt,
    camera: Option<CameraDecoder>,
    gaussians: Option<GaussianHead>,
}

pub struct HeadTensors {
    pub views: Vec<ViewTensors>,
    /// With a Gaussian head.
    pub gaussians: Vec<GaussianTensors>,
    /// Of joint views.
    pub cameras: Option<CameraTensors>,
    positions: Positions,
}

impl DepthHeads {
    pub fn new(p: &mut ParameterLayout, a: &DepthArchitecture) -> Self {
        Self {
            dpt: Dpt::new(p, a),
            camera: a.multi_view().then(|| CameraDecoder::new(p, a.feature_width())),
            gaussians: a.gaussians.then(|| GaussianHead::new(p, a)),
        }
    }

    /// View by view, to bound scratch.
    pub fn record(&self, rec: &mut Recorder, features: &DepthFeatures, grid: ViewGrid) -> HeadTensors {
        let mut positions = Positions::new(grid);
        let cameras = self.camera.as_ref().zip(features.cameras);
        let cameras = rec.scope("camera", |rec| cameras.map(|(decoder, tokens)| decoder.record(rec, tokens)));
        let patches = grid.patches();
        let (mut views, mut gaussians) = (Vec::new(), Vec::new());
        for first in (0..grid.views).map(|view| view * patches) {
            let layers: Vec<_> = features.layers.iter().map(|layer| layer.part(first..first + patches)).collect();
            views.push(self.dpt.record(rec, &layers, grid, &mut positions));
            if let Some(head) = &self.gaussians {
                gaussians.push(rec.scope("gaussians", |rec| head.record(rec, &layers, grid, &mut positions)));
            }
        }
        HeadTensors { views, gaussians, cameras, positions }
    }
}

impl HeadTensors {
    /// Writes positions and, for Gaussians, normalized `images` `[views, 3, pixels]`.
    pub fn write(&self, run: &mut Run, images: &[f32]) -> Result<()> {
        for (view, planes) in self.gaussians.iter().zip(images.chunks(images.len() / self.views.len())) {
            let area = planes.len() / 3;
            let pixel = |i: usize| [planes[i], planes[area + i], planes[2 * area + i], 0.0];
            run.write(view.picture, &(0..area).map(pixel).collect::<Vec<_>>())?;
        }
        self.positions.write(run)
    }
}
