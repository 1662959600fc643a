use super::convolution::{Convolution, ConvolutionOptions};
use crate::{
    gpu::{Recorder, Tensor},
    ops::{FeatureMap, HostParameter, ParameterLayout, Rows},
};

/// 1 x 1 convolutions over views.
pub(super) struct CameraDecoder {
    trunk: [Convolution; 2],
    translation: Convolution,
    quaternion: Convolution,
    fov: Convolution,
}

#[derive(Clone, Copy, Debug)]
pub enum CameraTensors {
    /// Depth Anything 3.
    Decoded {
        /// `[views, 3]`: camera centers.
        translations: Tensor,
        /// `[views, 4]`: unnormalized camera-to-world quaternions xyzw.
        quaternions: Tensor,
        /// `[views, 2]`: vertical and horizontal fields of view in radians, before ReLU.
        fovs: Tensor,
    },
    /// VGGT.
    Iterated {
        /// `[views, 9]`: world-to-camera translation, unnormalized quaternion xyzw, fields of view
        /// as above.
        encodings: Tensor,
        /// `[views, 12]`: input of the first pass, `empty` and padding.
        initial: Tensor,
        empty: HostParameter,
    },
}

impl CameraDecoder {
    pub fn new(p: &mut ParameterLayout, width: usize) -> Self {
        let root = "model.cam_dec";
        let mut layer =
            |name: &str, outputs| Convolution::of(p.exact_linear(&format!("{root}.{name}"), width, outputs), [1, 1]);
        Self {
            trunk: ["backbone.0", "backbone.2"].map(|name| layer(name, width)),
            translation: layer("fc_t", 3),
            quaternion: layer("fc_qvec", 4),
            fov: layer("fc_fov.0", 2),
        }
    }

    pub fn record(&self, rec: &mut Recorder, tokens: Rows) -> CameraTensors {
        let rectified = ConvolutionOptions::RECTIFIED;
        let x = FeatureMap::new(tokens, [1, tokens.count]);
        let x = self.trunk[0].record(rec, "hidden", x, ConvolutionOptions::default());
        let x = self.trunk[1].record(rec, "trunk", x, rectified);
        let mut out = |name, layer: &Convolution| {
            let tensor = layer.record(rec, name, x, rectified).rows.tensor;
            rec.output(tensor);
            tensor
        };
        CameraTensors::Decoded {
            translations: out("translations", &self.translation),
            quaternions: out("quaternions", &self.quaternion),
            fovs: out("fovs", &self.fov),
        }
    }
}
