use super::{
    CAMERA_NUMBERS, CameraRows, Depth, FrameInputs, FrameShape, Gradients, PlanCache, PlanKey, RenderOptions,
    RenderOutput, RenderOutputs, SceneTensors,
    backward::SplatGradients,
    camera_rows, first_capacity,
    range::{check, drawable},
};
use crate::{
    Error, Result,
    gpu::{Arena, Device, Recorder, Resident, ResidentLayout, Run, Tensor},
    types::{Camera, Scene},
};
use std::sync::Arc;

/// Gradients on the host; empty if not requested.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HostGradients {
    /// Of stored values, including unnormalized rotations.
    pub scene: Scene,
    /// As in [`Gradients::cameras`].
    pub cameras: Vec<[f32; CAMERA_NUMBERS]>,
    /// Of projected centers in pixels, `[cameras, Gaussians]`, at constant covariances.
    pub means2d: Vec<[f32; 2]>,
}

/// Requested gradients.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// With respect to Gaussians.
    pub scene: bool,
    /// With respect to cameras.
    pub cameras: bool,
    /// With respect to projected centers.
    pub means2d: bool,
}

/// Differentiates images on one device.
pub struct Differentiator {
    arena: Arena,
    memory: Option<Memory>,
    plans: PlanCache<(RenderOptions, Wanted), GradientPlan>,
}

struct Memory {
    resident: Arc<Resident>,
    scene: SceneTensors,
    gradients: SceneTensors,
}

struct GradientPlan {
    run: Run,
    cameras: Tensor,
    d_frames: Tensor,
    d_cameras: Option<Tensor>,
    d_splats: Option<SplatGradients>,
    outputs: RenderOutputs,
}

impl Differentiator {
    /// Creates its own arena.
    pub fn new(device: &Device) -> Self {
        Self { arena: Arena::new(device), memory: None, plans: PlanCache::new(device.limits(), 0) }
    }

    /// Returns gradients of the sum of pixels times `weights`. `None` weights are zero.
    ///
    /// # Errors
    /// [`Error::Argument`] for invalid input or rotations out of range; [`Error::Memory`] if one
    /// image does not fit.
    ///
    /// # Panics
    /// If `options` has outputs without gradients.
    pub fn differentiate(
        &mut self,
        scene: &Scene,
        cameras: &[Camera],
        options: &RenderOptions,
        weights: &[RenderOutput],
        wanted: Wanted,
    ) -> Result<HostGradients> {
        scene.validate()?;
        check(cameras, options)?;
        if matches!(drawable(&scene.quats), std::borrow::Cow::Owned(_)) {
            return Err(Error::argument(
                "quats",
                "one shorter than 1e-30 or longer than 1e30",
                "lengths between these",
            ));
        }
        if weights.len() != cameras.len() {
            let expected = format!("one for each of {} cameras", cameras.len());
            return Err(Error::argument("gradients of pictures", weights.len(), expected));
        }
        if scene.is_empty() {
            let cameras = if wanted.cameras { vec![[0.0; CAMERA_NUMBERS]; cameras.len()] } else { Vec::new() };
            return Ok(HostGradients { cameras, ..HostGradients::default() });
        }
        let _claim = self.arena.claim().expect("nobody else knows it");
        self.load(scene)?;
        let options = options.for_scene(scene);
        let mut found = HostGradients::default();
        for (camera, weights) in cameras.iter().zip(weights) {
            let values = interleaved(camera, weights, &options)?;
            self.add(camera, &options, &values, wanted, &mut found)?;
        }
        if let (true, Some(memory)) = (wanted.scene, &self.memory) {
            found.scene = memory.gradients.read(&memory.resident)?;
        }
        Ok(found)
    }

    fn load(&mut self, scene: &Scene) -> Result<()> {
        let size = (scene.len(), scene.sh_degree);
        let memory = match self.memory.take().filter(|memory| (memory.scene.len, memory.scene.sh_degree) == size) {
            Some(memory) => memory,
            None => {
                self.plans = PlanCache::new(self.arena.device().limits(), first_capacity(scene.len()));
                Memory::new(self.arena.device(), size)?
            }
        };
        memory.write(scene)?;
        self.memory = Some(memory);
        Ok(())
    }

    fn add(
        &mut self,
        camera: &Camera,
        options: &RenderOptions,
        weights: &[f32],
        wanted: Wanted,
        found: &mut HostGradients,
    ) -> Result<()> {
        let shape = FrameShape::of(camera);
        let key = PlanKey { shape, backward: true, options: (*options, wanted) };
        let memory = self.memory.as_ref().expect("loaded before");
        let record = |capacity| GradientPlan::new(&self.arena, memory, shape, *options, wanted, capacity);
        // Plans that overflow accumulate nothing.
        let plan = self.plans.run(key, record, |plan| {
            plan.run.write(plan.cameras, &[camera_rows(camera)])?;
            plan.run.write(plan.d_frames, weights)?;
            plan.run.execute()?;
            plan.outputs.needed(&plan.run)
        })?;
        if let Some(d_cameras) = plan.d_cameras {
            found.cameras.extend(plan.run.read::<[f32; CAMERA_NUMBERS]>(d_cameras)?);
        }
        if let Some(SplatGradients { conics, d_pairs }) = plan.d_splats {
            found.means2d.extend(SplatGradients::means2d(&plan.run.read(conics)?, &plan.run.read(d_pairs)?));
        }
        Ok(())
    }
}

impl GradientPlan {
    fn new(
        arena: &Arena,
        memory: &Memory,
        shape: FrameShape,
        options: RenderOptions,
        wanted: Wanted,
        capacity: usize,
    ) -> Result<Self> {
        let Memory { resident, scene, .. } = memory;
        let mut rec = Recorder::new(arena.device().limits());
        let cameras = rec.input::<CameraRows>("cameras", 1);
        let values = options.channels() * shape.pixels();
        let d_frames = rec.input::<f32>("d_frames", values);
        let d_cameras = wanted.cameras.then(|| rec.tensor::<[f32; CAMERA_NUMBERS]>("d_cameras", 1));
        d_cameras.iter().for_each(|tensor| rec.fill(*tensor, 0));
        let gradients = Gradients { scene: wanted.scene.then_some(memory.gradients), cameras: d_cameras };
        let given = |_: &mut Recorder, _| d_frames;
        let inputs = FrameInputs { scene, cameras, shape, options: &options, capacity };
        let (outputs, splats) = inputs.record_with_gradients(&mut rec, given, &gradients);
        let d_splats = wanted.means2d.then_some(splats);
        let d_splats_tensors = d_splats.iter().flat_map(|splats| [splats.conics, splats.d_pairs]);
        d_cameras.into_iter().chain(d_splats_tensors).for_each(|tensor| rec.output(tensor));
        let run = Run::in_arena(arena, 0, rec.finish()?, [resident.clone()])?;
        Ok(Self { run, cameras, d_frames, d_cameras, d_splats, outputs })
    }
}

impl Memory {
    fn new(device: &Device, (len, sh_degree): (usize, u32)) -> Result<Self> {
        let mut layout = ResidentLayout::new(device.limits());
        let scene = SceneTensors::lay_out(&mut layout, len, sh_degree);
        let gradients = SceneTensors::lay_out(&mut layout, len, sh_degree);
        Ok(Self { resident: Arc::new(Resident::new(device, &layout)?), scene, gradients })
    }

    fn write(&self, scene: &Scene) -> Result<()> {
        self.scene.write(&self.resident, scene)?;
        let zero = |tensor: Tensor| self.resident.write(tensor, &vec![0u8; tensor.bytes() as usize]);
        self.gradients.all().into_iter().try_for_each(zero)
    }
}

/// Missing outputs are 0.
fn interleaved(camera: &Camera, weights: &RenderOutput, options: &RenderOptions) -> Result<Vec<f32>> {
    let pixels = FrameShape::of(camera).pixels();
    let asked = [
        ("color", options.rgb, &weights.rgb, 3),
        ("alpha", options.alpha, &weights.alpha, 1),
        ("depth", options.depth.is_some(), &weights.depth, 1),
    ];
    let (channels, mut first) = (options.channels(), 0);
    let mut values = vec![0.0; pixels * channels];
    for (what, _, plane, width) in asked.into_iter().filter(|(_, asked, ..)| *asked) {
        if let Some(plane) = plane {
            if plane.len() != pixels * width {
                let name = format!("gradient of {what}");
                return Err(Error::argument(name, plane.len(), format!("{} values", pixels * width)));
            }
            let pixels = values.chunks_exact_mut(channels).zip(plane.chunks_exact(width));
            pixels.for_each(|(to, from)| to[first..first + width].copy_from_slice(from));
        }
        first += width;
    }
    Ok(values)
}

impl RenderOptions {
    /// Adds alpha if expected depth needs it.
    pub fn differentiable(self) -> Self {
        Self { alpha: self.alpha || self.depth == Some(Depth::Expected), ..self }
    }
}
