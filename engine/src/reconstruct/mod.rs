//! Reconstruction of scenes from photos.

mod blocks;
mod features;
mod network;
mod options;
mod patches;
mod prepare;
mod token_selection;

pub use crate::ops::KvPool;
pub use blocks::{Block, BlockLayout, BlockOptions, Seam};
pub use features::{BackboneFeatures, SceneTokens};
pub(crate) use network::Inputs;
pub use network::{Network, NetworkPlan, Tensors};
pub use options::{MAX_PATCHES, MAX_PHOTOS, MAX_VIEWS, Ratio, ReconstructOptions, SceneFrame, Shape};
pub(crate) use options::{check_cameras, grid, no_camera_encoder, size_of};
pub use patches::Patches;
pub use prepare::{Placement, Prepared};
pub(crate) use token_selection::SelectedTokens;
pub use token_selection::{TokenSampling, TokenSelection};

use crate::{
    Error, Result,
    cameras::CameraEstimate,
    gpu::{Arena, Device, Plan, Profile, Progress, Recorder, ResidentLayout, Run, StageTimes},
    ops::{Arithmetic, Parameters, Precision},
    stages::render::{DeviceScene, SceneMemory, SceneSource},
    tune::KernelChoice,
    types::{Camera, Image, Scene, SkippedPass, near},
    weights::{Architecture, Checkpoint},
};
use network::Choice;
use patches::{all_masked, masked_patches};
use std::{ops::ControlFlow, sync::Mutex};

/// A reconstructed scene.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// Gaussians in the first view's camera frame.
    pub gaussians: DeviceScene,
    /// Relation to the photos, if they were not given as views.
    pub placement: Option<Placement>,
    /// Number of decoded tokens.
    pub tokens: usize,
    /// Source patches; tokens have equally many consecutive Gaussians.
    pub patches: Patches,
    /// Tokens of unmasked patches, if photos have masks: those of `patches`.
    pub unmasked: Option<Vec<usize>>,
    /// Time per stage.
    pub times: StageTimes,
    /// Work per kernel.
    pub outline: Profile,
    /// Skipped stages.
    pub skipped_passes: Vec<SkippedPass>,
    /// Seams between blocks of views: none after one pass.
    pub seams: Vec<Seam>,
    /// Arena, weight and Gaussian bytes.
    pub peak_bytes: u64,
}

impl<'a> From<&'a Reconstruction> for SceneSource<'a> {
    fn from(made: &'a Reconstruction) -> Self {
        Self::Device(&made.gaussians, made.placement.as_ref().and_then(|placement| placement.pose))
    }
}

/// Options of [`Model::load_with`].
#[derive(Clone, Debug, Default)]
pub struct ModelOptions {
    /// Precision of matrix products; by default the fastest that the device computes correctly.
    pub precision: Option<Precision>,
    /// Architecture of a checkpoint that names none.
    pub variant: Option<String>,
}

/// A network on a device.
pub struct Model {
    device: Device,
    network: Network,
    image_size: u32,
    parameters: Parameters,
    arena: Arena,
    recorded: Mutex<Option<Recorded>>,
}

struct Recorded {
    shape: Shape,
    run: Run,
    tensors: Tensors,
    layout: ResidentLayout,
    scenes: Vec<SceneMemory>,
}

const SCENES: usize = 2;

impl Reconstruction {
    /// Reads the Gaussians of unmasked patches.
    pub fn to_scene(&self) -> Result<Scene> {
        let mut scene = self.gaussians.read()?;
        if let Some(tokens) = &self.unmasked {
            let each = scene.len() / self.tokens;
            scene.keep(&tokens.iter().flat_map(|token| token * each..(token + 1) * each).collect::<Vec<_>>());
        }
        if let Some(pose) = self.placement.as_ref().and_then(|placement| placement.pose) {
            scene.place(1.0, &pose);
        }
        Ok(scene)
    }

    /// Estimates the photos' cameras from [`Reconstruction::to_scene`], see [`Patches::cameras`].
    ///
    /// # Errors
    /// [`Error::Argument`] for known cameras or another scene.
    pub fn cameras(&self, scene: &Scene, focal: Option<f64>) -> Result<Vec<Result<CameraEstimate>>> {
        let mut found = self.patches.cameras(scene, focal)?;
        let maps = self.placement.iter().flat_map(|placement| &placement.maps);
        for (estimate, map) in found.iter_mut().zip(maps).filter_map(|(found, map)| Some((found.as_mut().ok()?, map))) {
            estimate.camera.intrinsics = map.undo(&estimate.camera.intrinsics);
        }
        Ok(found)
    }
}

impl Model {
    /// Loads `builtin`, a checkpoint's path, or `seeded:VARIANT` for random weights.
    ///
    /// # Errors
    /// As [`Checkpoint::open`]; [`Error::Memory`].
    pub fn load(device: &Device, weights: &str) -> Result<Self> {
        Self::load_with(device, weights, &ModelOptions::default(), |_| ControlFlow::Continue(()))
    }

    /// As [`Model::load`], with options and progress from 0 to 1.
    ///
    /// # Errors
    /// Those of [`Model::load`], and [`Error::Argument`] for an unsupported precision.
    pub fn load_with(
        device: &Device,
        weights: &str,
        options: &ModelOptions,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let checkpoint = Checkpoint::parse(weights, options.variant.as_deref())?;
        let KernelChoice { arithmetic, .. } = KernelChoice::of(device, options.precision)?;
        Self::from_checkpoint_with(device, &checkpoint, arithmetic, progress)
    }

    /// Loads a checkpoint in f32.
    pub fn from_checkpoint(
        device: &Device,
        checkpoint: &Checkpoint,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        Self::from_checkpoint_with(device, checkpoint, KernelChoice::exact(device), progress)
    }

    /// [`Model::from_checkpoint`] with an arithmetic.
    pub fn from_checkpoint_with(
        device: &Device,
        checkpoint: &Checkpoint,
        arithmetic: Arithmetic,
        progress: impl FnMut(f64) -> ControlFlow<()>,
    ) -> Result<Self> {
        let network = Network::of(checkpoint, device.limits(), arithmetic)?;
        let parameters = network.parameters.load(device, &**checkpoint, progress)?;
        let (arena, recorded) = (Arena::new(device), Mutex::default());
        let image_size = checkpoint.image_size();
        Ok(Self { device: device.clone(), network, image_size, parameters, arena, recorded })
    }

    /// Weight bytes on the device.
    pub fn weight_bytes(&self) -> u64 {
        self.network.weight_bytes()
    }

    /// Side of its square training images.
    pub fn image_size(&self) -> u32 {
        self.image_size
    }

    /// Architecture.
    pub fn architecture(&self) -> &Architecture {
        &self.network.architecture
    }

    /// Arena of its scenes.
    pub fn arena(&self) -> &Arena {
        &self.arena
    }

    /// Reconstructs a scene in one pass from images of one size, a multiple of the patch size, and
    /// their cameras.
    pub fn reconstruct_views(
        &self,
        images: &[Image],
        options: &ReconstructOptions,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        let made = self.pass(images, options, progress)?;
        if made.patches.is_empty() { Err(all_masked()) } else { Ok(made) }
    }

    /// As [`Model::reconstruct_views`], but all patches may be masked.
    fn pass(
        &self,
        images: &[Image],
        options: &ReconstructOptions,
        mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        let shape = self.shape(images, options)?;
        self.in_arena(|arena, recorded| {
            if recorded.as_ref().is_none_or(|recorded| recorded.shape != shape) {
                *recorded = None;
                *recorded = Some(self.record_for(arena, shape)?);
            }
            let Some(Recorded { run, tensors, layout, scenes, .. }) = recorded else { unreachable!("just recorded") };
            let free = match scenes.iter().position(SceneMemory::is_free) {
                Some(free) => free,
                None => {
                    scenes.truncate(SCENES - 1);
                    scenes.push(SceneMemory::new(&self.device, layout, *tensors.scene())?.made_in(arena));
                    scenes.len() - 1
                }
            };
            run.replace_resident(scenes[free].resident().clone());
            self.write_photos(run, &tensors.inputs, shape, images, options)?;
            let masked = masked_patches(shape.grid, images);
            let outputs = Outputs { choice: tensors.choice, scene: &mut scenes[free] };
            self.decode(run, outputs, shape, options, masked.as_deref(), &mut progress)
        })
    }

    /// Calls `work` with the claimed arena and its recorded plan, or with a new arena. If memory is
    /// short, frees plan and arena, which renderings may have grown, and repeats `work`.
    fn in_arena<T>(&self, mut work: impl FnMut(&Arena, &mut Option<Recorded>) -> Result<T>) -> Result<T> {
        let (arena, claim) = self.arena.claimed();
        // The claim is exclusive; a panic leaves no partial state.
        let own = claim.as_ref().map(|_| self.recorded.lock().unwrap_or_else(|poisoned| poisoned.into_inner()));
        let (mut own, mut other) = (own, None);
        let recorded = own.as_deref_mut().unwrap_or(&mut other);
        match work(&arena, recorded) {
            Err(Error::Memory { .. }) => {
                *recorded = None;
                arena.release()?;
                work(&arena, recorded)
            }
            done => done,
        }
    }

    /// Executes a run that writes a scene without `masked` patches.
    fn decode(
        &self,
        run: &mut Run,
        Outputs { choice, scene }: Outputs<'_>,
        shape: Shape,
        options: &ReconstructOptions,
        masked: Option<&[bool]>,
        progress: impl FnMut(Progress<'_>) -> ControlFlow<()>,
    ) -> Result<Reconstruction> {
        write_choice(run, choice, shape, options)?;
        let times = run.execute_with(progress)?;
        let mut patches = Patches::of(run, choice, shape, options)?;
        let unmasked = patches.drop_masked(masked);
        scene.show_tokens(unmasked.as_deref(), shape.tokens)?;
        let gaussians = scene.scene(self.architecture().sh_degree as u32, near(options.scale()), false);
        Ok(Reconstruction {
            tokens: shape.tokens,
            patches,
            unmasked,
            times,
            outline: Profile::outline(run.plan()),
            skipped_passes: shape.skipped_passes(),
            seams: Vec::new(),
            peak_bytes: run.plan().arena_bytes() + self.weight_bytes() + gaussians.bytes(),
            gaussians,
            placement: None,
        })
    }

    fn record_for(&self, arena: &Arena, shape: Shape) -> Result<Recorded> {
        let NetworkPlan { plan, tensors, layout } = self.network.plan(self.device.limits(), shape)?;
        let scene = SceneMemory::new(&self.device, &layout, *tensors.scene())?.made_in(arena);
        let run = Run::in_arena(arena, 0, plan, [self.parameters.resident.clone(), scene.resident().clone()])?;
        Ok(Recorded { shape, run, tensors, layout, scenes: vec![scene] })
    }

    /// Plans a reconstruction.
    pub fn plan(&self, shape: Shape) -> Result<NetworkPlan> {
        self.network.plan(self.device.limits(), shape)
    }

    /// Returns the shape for these options.
    pub fn shape(&self, images: &[Image], options: &ReconstructOptions) -> Result<Shape> {
        let size = size_of(images)?;
        let scale = options.scale();
        // Scenes are f32.
        if !(scale as f32).is_normal() || scale < 0.0 {
            return Err(Error::argument("scene scale", scale, "a length above 0"));
        }
        if let Some(cameras) = &options.cameras {
            check_cameras(cameras, images)?;
        }
        self.shape_of_views(images.len(), size, options)
    }

    fn shape_of_views(&self, views: usize, size: [u32; 2], options: &ReconstructOptions) -> Result<Shape> {
        let ReconstructOptions { ratio, token_selection, cameras, kv_pool, .. } = options;
        let shape = Shape::new(self.architecture(), views, size, *ratio, token_selection, cameras.is_some())?;
        Ok(shape.pooled(*kv_pool))
    }

    /// Records a plan, optionally observed.
    pub fn record(&self, shape: Shape, observe: bool) -> Result<(Plan, Tensors)> {
        let mut rec = Recorder::new(self.device.limits());
        if observe {
            rec = rec.observing();
        }
        let tensors = self.network.record(&mut rec, shape);
        Ok((rec.finish()?, tensors))
    }

    /// Allocates a plan.
    pub fn run(&self, plan: Plan) -> Result<Run> {
        Run::with_resident(&self.device, plan, Some(self.parameters.resident.clone()))
    }

    /// Writes the inputs.
    pub fn write_inputs(
        &self,
        run: &mut Run,
        tensors: &Tensors,
        shape: Shape,
        images: &[Image],
        options: &ReconstructOptions,
    ) -> Result<()> {
        self.write_photos(run, &tensors.inputs, shape, images, options)?;
        write_choice(run, tensors.choice, shape, options)
    }

    fn write_photos(
        &self,
        run: &mut Run,
        inputs: &Inputs,
        shape: Shape,
        images: &[Image],
        options: &ReconstructOptions,
    ) -> Result<()> {
        run.write(inputs.images, &planar(images))?;
        let in_units = |camera: &Camera| {
            let mut camera = *camera;
            camera.pose.translation /= options.scale();
            camera
        };
        let cameras = options.cameras.as_ref().map(|cameras| cameras.iter().map(in_units).collect::<Vec<_>>());
        let backbone = &self.network.stages.backbone;
        backbone.write(run, &inputs.backbone, shape.grid, cameras.as_deref(), &self.parameters)
    }
}

struct Outputs<'a> {
    choice: Choice,
    scene: &'a mut SceneMemory,
}

fn write_choice(run: &mut Run, choice: Choice, shape: Shape, options: &ReconstructOptions) -> Result<()> {
    if let Some(scene_scale) = choice.scene_scale {
        run.write(scene_scale, &[options.scale() as f32])?;
    }
    choice.selected.write(run, &options.token_selection, shape.grid.tokens(), shape.tokens)
}

/// RGB8 to `[views, 3, height, width]` f32 in 0..1. The network sees masked pixels as gray.
pub(crate) fn planar(images: &[Image]) -> Vec<f32> {
    let mut out = Vec::with_capacity(images.iter().map(|i| i.rgb.len()).sum());
    for image in images.iter().map(Image::hidden) {
        for channel in 0..3 {
            out.extend(image.rgb[channel..].iter().step_by(3).map(|v| *v as f32 / 255.0));
        }
    }
    out
}
