//! The network: one line a stage, values named by meaning.

use super::{Kept, Shape};
use crate::{
    Result,
    gpu::{Limits, Recorder, Run, Tensor},
    ops::{Arithmetic, ParameterLayout},
    stages::{
        backbone::{Backbone, BackboneInputs, POSE_VALUES},
        cluster,
        fuse::Fuse,
        gaussians::{GaussianTensors, Gaussians},
    },
    types::Scene,
    weights::Architecture,
};

/// A network's parameters, laid out for a device.
pub struct Network {
    pub(super) architecture: Architecture,
    pub(super) parameters: ParameterLayout,
    backbone: Backbone,
    fuse: Fuse,
    gaussians: Gaussians,
}

/// The tensors that go in and out of a plan.
#[derive(Clone, Copy, Debug)]
pub struct Tensors {
    pub(super) inputs: BackboneInputs,
    /// First centroids' tokens, or the tokens themselves; absent at ratio 1.
    pub(super) indices: Option<Tensor>,
    scene: GaussianTensors,
}

impl Network {
    /// Lays out a network; needs no device.
    pub fn new(architecture: &Architecture, limits: &Limits, arithmetic: Arithmetic) -> Self {
        let mut parameters = ParameterLayout::new(limits, arithmetic);
        Self {
            backbone: Backbone::new(&mut parameters, architecture),
            fuse: Fuse::new(&mut parameters, architecture),
            gaussians: Gaussians::new(&mut parameters, architecture),
            architecture: architecture.clone(),
            parameters,
        }
    }

    /// Bytes of the weights on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.parameters.bytes()
    }

    /// Records the whole forward pass.
    pub fn record(&self, rec: &mut Recorder, shape: Shape) -> Tensors {
        let Shape { grid, tokens, .. } = shape;
        let inputs = self.inputs(rec, shape);
        let indices = (shape.kept != Kept::All).then(|| rec.input::<u32>("indices", tokens));

        let layers = rec.scope("backbone", |rec| self.backbone.record(rec, inputs, grid));
        let chosen = rec.scope("cluster", |rec| match (indices, shape.kept) {
            (Some(initial), Kept::Kmeans(rounds)) => {
                let sizes = [grid.tokens(), tokens, self.architecture.width];
                Some(cluster::record(rec, self.parameters.nearest(), layers[0], initial, sizes, rounds))
            }
            (given, _) => given,
        });
        let chosen = chosen.map(|indices| (indices, tokens));
        let scene = rec.scope("fuse", |rec| self.fuse.record(rec, &layers, grid.tokens(), chosen));
        let scene = rec.scope("gaussians", |rec| {
            let tokens = self.gaussians.tokens(rec, scene, inputs.images, grid, chosen);
            self.gaussians.record(rec, tokens)
        });

        for tensor in [scene.means, scene.scales, scene.quats, scene.opacities, scene.sh_coeffs] {
            rec.output(tensor);
        }
        Tensors { inputs, indices, scene }
    }

    fn inputs(&self, rec: &mut Recorder, shape: Shape) -> BackboneInputs {
        let (a, grid) = (&self.architecture, shape.grid);
        let tokens = 1 + grid.patches();
        let rotary = ["local", "global"].map(|kind| rec.input::<f32>(&format!("rotary_{kind}"), tokens * a.head_dim()));
        BackboneInputs {
            images: rec.input::<f32>("images", grid.values()),
            positions: rec.input::<f32>("positions", tokens * a.width),
            rotary,
            poses: shape.cameras.then(|| rec.input::<[f32; POSE_VALUES]>("poses", grid.views)),
        }
    }
}

impl Tensors {
    /// Reads the scene after a run.
    ///
    /// # Errors
    /// Where a transfer fails.
    pub fn read(&self, run: &Run, sh_degree: u32) -> Result<Scene> {
        Ok(Scene {
            means: run.read(self.scene.means)?,
            scales: run.read(self.scene.scales)?,
            quats: run.read(self.scene.quats)?,
            opacities: run.read(self.scene.opacities)?,
            sh_coeffs: run.read(self.scene.sh_coeffs)?,
            sh_degree,
        })
    }
}
