//! Photos to a scene: one line a stage.

use crate::{
    Error, Result,
    gpu::{Device, Limits, Plan, Progress, Recorder, Resident, Run, StageTimes, Tensor},
    ops::ParameterLayout,
    stages::{
        ViewGrid,
        backbone::{Backbone, BackboneInputs, POSE_VALUES, interpolate_positions, rotary_tables},
        cluster::{self, auto_ratio, cluster_count, even_indices, random_indices},
        fuse::Fuse,
        gaussians::{GaussianTensors, Gaussians},
    },
    types::{Camera, Image, Scene, prior_encoding},
    weights::{Architecture, Checkpoint},
};
use std::{ops::ControlFlow, sync::Arc};

/// Most views of one reconstruction.
pub const MAX_VIEWS: usize = 192;

/// Most patches of all views: what kernels count of each fits 32 bits.
pub const MAX_PATCHES: usize = 1 << 20;

/// Share of the tokens that are kept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Ratio {
    /// A number in (0, 1]; at 1 every token is kept and nothing is clustered.
    Fixed(f64),
    /// 0.5 sqrt(2 / views), the paper's.
    Auto,
}

/// How the kept tokens are chosen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Selection {
    /// The nearest token of each centroid of k-means.
    Kmeans,
    /// Evenly spread.
    Stride,
    /// Random ones, the same for the same seed.
    Random(u64),
    /// These.
    Given(Vec<u32>),
}

/// What to reconstruct.
#[derive(Clone, Debug)]
pub struct Request {
    /// Share of tokens kept.
    pub ratio: Ratio,
    /// How they are chosen.
    pub selection: Selection,
    /// Known cameras of all views, of the images' own size, or none.
    pub cameras: Option<Vec<Camera>>,
}

impl Default for Request {
    /// Every token, no cameras.
    fn default() -> Self {
        Self { ratio: Ratio::Fixed(1.0), selection: Selection::Kmeans, cameras: None }
    }
}

/// A scene and how it came about.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// The Gaussians; the world is the first view's camera.
    pub scene: Scene,
    /// Tokens that became Gaussians.
    pub tokens: usize,
    /// Time of each stage.
    pub times: StageTimes,
    /// Bytes of the arena and of the weights.
    pub peak_bytes: u64,
}

/// A network's parameters, laid out for a device.
pub struct Network {
    architecture: Architecture,
    parameters: ParameterLayout,
    backbone: Backbone,
    fuse: Fuse,
    gaussians: Gaussians,
}

/// Everything that decides a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Views and their patches.
    pub grid: ViewGrid,
    /// Tokens kept; all where equal to the grid's.
    pub tokens: usize,
    /// Whether they are found by k-means, not given.
    pub kmeans: bool,
    /// Whether cameras are given.
    pub cameras: bool,
}

/// The tensors that go in and out of a plan.
#[derive(Clone, Copy, Debug)]
pub struct Tensors {
    inputs: BackboneInputs,
    /// First centroids' tokens, or the tokens themselves; absent at ratio 1.
    indices: Option<Tensor>,
    scene: GaussianTensors,
}

impl Shape {
    /// The shape of a reconstruction from `views` pictures of `[width, height]` pixels; needs no device.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub fn new(
        architecture: &Architecture,
        views: usize,
        [width, height]: [u32; 2],
        chosen: (Ratio, &Selection),
        cameras: bool,
    ) -> Result<Self> {
        let grid = grid(architecture.patch, views, width as usize, height as usize)?;
        let all = grid.tokens();
        let tokens = match chosen {
            (_, Selection::Given(indices)) => {
                if indices.is_empty() || indices.iter().any(|i| *i as usize >= all) {
                    let found = format!("{} indices", indices.len());
                    return Err(Error::argument("given tokens", found, format!("at least one, all below {all}")));
                }
                indices.len()
            }
            (wanted, _) => cluster_count(all, ratio(wanted, views)?),
        };
        Ok(Self { grid, tokens, kmeans: *chosen.1 == Selection::Kmeans, cameras })
    }
}

impl Network {
    /// Lays out a network; needs no device.
    pub fn new(architecture: &Architecture, limits: &Limits) -> Self {
        let mut parameters = ParameterLayout::new(limits);
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
        let reduced = tokens < grid.tokens();
        let indices = reduced.then(|| rec.input::<u32>("indices", tokens));

        let layers = rec.scope("backbone", |rec| self.backbone.record(rec, inputs, grid));
        let chosen = rec.scope("cluster", |rec| match indices {
            Some(initial) if shape.kmeans => {
                Some(cluster::record(rec, layers[0], initial, grid.tokens(), tokens, self.architecture.width))
            }
            given => given,
        });
        let chosen = chosen.map(|indices| (indices, tokens));
        let scene = rec.scope("fuse", |rec| self.fuse.record(rec, &layers, grid.tokens(), chosen));
        let scene = rec.scope("gaussians", |rec| self.gaussians.record(rec, scene, inputs.images, grid, chosen));

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

/// A network with its weights on a device.
pub struct Model {
    device: Device,
    network: Network,
    resident: Arc<Resident>,
    learned_positions: Vec<f32>,
}

impl Model {
    /// Loads a checkpoint onto a device. `progress` gets the share that is done and may stop the loading.
    ///
    /// # Errors
    /// Where the device has too little memory or the checkpoint cannot be read; [`Error::Cancelled`].
    pub fn load(
        device: &Device,
        checkpoint: &Checkpoint,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let network = Network::new(checkpoint.architecture(), device.limits());
        let resident = Arc::new(network.parameters.load(device, checkpoint, progress)?);
        let name = "backbone.backbone.pos_embed";
        let mut learned_positions = vec![0.0; checkpoint.shape(name)?.iter().product()];
        checkpoint.read_f32(name, &mut learned_positions)?;
        Ok(Self { device: device.clone(), network, resident, learned_positions })
    }

    /// Bytes of the weights on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.network.weight_bytes()
    }

    /// The network's architecture.
    pub fn architecture(&self) -> &Architecture {
        &self.network.architecture
    }

    /// Reconstructs a scene from images of one size, whose sides are multiples of the patch.
    ///
    /// # Errors
    /// [`Error::Argument`] for images or a request that cannot be used, [`Error::Memory`] where the device has too
    /// little (nothing was submitted then), [`Error::Cancelled`] where `progress` asked to stop.
    pub fn reconstruct(
        &self,
        images: &[Image],
        request: &Request,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        let shape = self.shape(images, request)?;
        let mut rec = Recorder::new(self.device.limits());
        let tensors = self.network.record(&mut rec, shape);
        let mut run = self.run(rec.finish()?)?;
        self.write_inputs(&mut run, &tensors, shape, images, request)?;
        let times = run.execute_with(progress)?;
        Ok(Reconstruction {
            scene: tensors.read(&run, self.architecture().sh_degree as u32)?,
            tokens: shape.tokens,
            times,
            peak_bytes: run.plan().arena_bytes() + self.network.weight_bytes(),
        })
    }

    /// The shape of a request for these images.
    ///
    /// # Errors
    /// [`Error::Argument`] for whatever cannot be used.
    pub fn shape(&self, images: &[Image], request: &Request) -> Result<Shape> {
        let size = images.first().map_or([0; 2], |first| [first.width, first.height]);
        for (i, image) in images.iter().enumerate() {
            if [image.width, image.height] != size {
                let found = format!("{} x {}", image.width, image.height);
                let expected = format!("{} x {}, as view 0", size[0], size[1]);
                return Err(Error::argument(format!("size of view {i}"), found, expected));
            }
            image.validate()?;
        }
        if let Some(cameras) = &request.cameras {
            check_cameras(cameras, images)?;
        }
        let chosen = (request.ratio, &request.selection);
        Shape::new(self.architecture(), images.len(), size, chosen, request.cameras.is_some())
    }

    /// Records a plan for a shape, observing its intermediate tensors where asked.
    pub fn record(&self, shape: Shape, observe: bool) -> Result<(Plan, Tensors)> {
        let mut rec = Recorder::new(self.device.limits());
        if observe {
            rec = rec.observing();
        }
        let tensors = self.network.record(&mut rec, shape);
        Ok((rec.finish()?, tensors))
    }

    /// Allocates a plan of this model.
    ///
    /// # Errors
    /// [`Error::Memory`] where the device has too little.
    pub fn run(&self, plan: Plan) -> Result<Run> {
        Run::with_resident(&self.device, plan, Some(self.resident.clone()))
    }

    /// Writes everything that a run of this shape reads.
    ///
    /// # Errors
    /// Where a transfer fails or the cameras cannot be used.
    pub fn write_inputs(
        &self,
        run: &mut Run,
        tensors: &Tensors,
        shape: Shape,
        images: &[Image],
        request: &Request,
    ) -> Result<()> {
        let (a, grid) = (self.architecture(), shape.grid);
        run.write(tensors.inputs.images, &planar(images))?;
        let positions =
            interpolate_positions(&self.learned_positions, a.position_grid, a.width, grid.rows, grid.columns);
        run.write(tensors.inputs.positions, &positions)?;
        for (tensor, table) in tensors.inputs.rotary.iter().zip(rotary_tables(grid.rows, grid.columns, a.head_dim())) {
            run.write(*tensor, &table)?;
        }
        if let (Some(tensor), Some(cameras)) = (tensors.inputs.poses, &request.cameras) {
            let padded: Vec<_> = prior_encoding(cameras)?
                .iter()
                .map(|e| std::array::from_fn::<f32, POSE_VALUES, _>(|i| e.get(i).copied().unwrap_or(0.0)))
                .collect();
            run.write(tensor, &padded)?;
        }
        if let Some(tensor) = tensors.indices {
            let indices = match &request.selection {
                Selection::Kmeans | Selection::Stride => even_indices(grid.tokens(), shape.tokens),
                Selection::Random(seed) => random_indices(grid.tokens(), shape.tokens, *seed),
                Selection::Given(indices) => indices.clone(),
            };
            run.write(tensor, &indices)?;
        }
        Ok(())
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

fn grid(patch: usize, views: usize, width: usize, height: usize) -> Result<ViewGrid> {
    if !(1..=MAX_VIEWS).contains(&views) {
        return Err(Error::argument("views", views, format!("1 to {MAX_VIEWS}")));
    }
    let fail = |expected| Err(Error::argument("size of the views", format!("{width} x {height}"), expected));
    if width == 0 || height == 0 || !width.is_multiple_of(patch) || !height.is_multiple_of(patch) {
        return fail(format!("multiples of {patch}"));
    }
    let grid = ViewGrid { views, rows: height / patch, columns: width / patch, patch };
    if grid.tokens() > MAX_PATCHES {
        return fail(format!("at most {MAX_PATCHES} patches of {patch} x {patch} in {views} views"));
    }
    Ok(grid)
}

/// A ratio as a number.
fn ratio(ratio: Ratio, views: usize) -> Result<f64> {
    match ratio {
        Ratio::Auto => Ok(auto_ratio(views)),
        Ratio::Fixed(r) if r > 0.0 && r <= 1.0 => Ok(r),
        Ratio::Fixed(r) => Err(Error::argument("ratio", r, "a number in (0, 1], or auto")),
    }
}

fn check_cameras(cameras: &[Camera], images: &[Image]) -> Result<()> {
    if cameras.len() != images.len() {
        return Err(Error::argument("cameras", cameras.len(), format!("{}, one a view", images.len())));
    }
    for (i, (camera, image)) in cameras.iter().zip(images).enumerate() {
        camera.validate(&format!("camera of view {i}"))?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        if size != (image.width, image.height) {
            let expected = format!("{} x {}, as the image", image.width, image.height);
            return Err(Error::argument(format!("size of camera {i}"), format!("{} x {}", size.0, size.1), expected));
        }
    }
    Ok(())
}

/// RGB8 interleaved -> `[views, 3, height, width]` f32 in 0..1.
fn planar(images: &[Image]) -> Vec<f32> {
    let mut out = Vec::with_capacity(images.iter().map(|i| i.rgb.len()).sum());
    for image in images {
        for channel in 0..3 {
            out.extend(image.rgb[channel..].iter().step_by(3).map(|v| *v as f32 / 255.0));
        }
    }
    out
}
