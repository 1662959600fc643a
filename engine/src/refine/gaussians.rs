//! A step accumulates gradients over plan runs, so memory is independent of the number of photos.

use super::{
    Adam, LearningRates, PerceptualLoss, Rate, RefineOptions, Space,
    checkpoint::State,
    growth::padded,
    planned::{PhotoLoss, PhotoPlan, StepInputs, Training, record_photos},
    record_adam, record_anisotropy_limit,
    views::View,
};
use crate::{
    Error, Result,
    gpu::{Arena, Device, Limits, Profile, Recorder, Resident, ResidentLayout, Run, Tensor},
    perceptual::{LpipsWeights, Perceptual},
    random::Random,
    stages::render::{FrameShape, Gradients, PlanCache, PlanKey, RenderOptions, SceneTensors, first_capacity},
    types::{Scene, unit_quaternion},
};
use std::sync::Arc;

/// As in 3D Gaussian Splatting: the gradient of a mean over a picture is small.
pub(super) const ADAM: Adam = Adam { beta1: 0.9, beta2: 0.999, eps: 1e-15 };
/// Adam's eps for Gaussians, times their number. Gradients far below it, as of barely constrained
/// Gaussians, take less than a full step.
const EPS: f32 = 0.006;
/// The same for means, also times the scene scale.
const MEANS_EPS: f32 = 0.6;
/// Least scale, and least distance of opacities from 0 and 1, for logarithm and logit.
const LEAST_SCALE: f32 = 1e-12;
const OPACITY_MARGIN: f32 = 1e-4;
/// Limit of the largest scale relative to the middle one: longer needles fit noise.
const MAX_ANISOTROPY: f32 = 5.0;
/// Rate of that limit relative to the scales' rate: above 1 to prevail.
const LIMIT_RATE: f32 = 2.0;
const MAX_BATCH_PIXELS: usize = 1 << 20;
/// Cached plans: a few sizes, with and without masks, and last batches.
const PLANS: usize = 12;

struct Field {
    values: Tensor,
    gradient: Tensor,
    moments: [Tensor; 2],
    len: usize,
    rate: Rate,
    space: Space,
    eps: f32,
    /// Gradient of the penalty, equal for all values: the initial gradient.
    penalty: f32,
}

pub(super) struct Gaussians {
    arena: Arena,
    memories: Vec<Arc<Resident>>,
    fields: Vec<Field>,
    scene: SceneTensors,
    drawing: RenderOptions,
    gradients: Gradients,
    /// Tokens and their moments, if refined, and the plan that decodes them.
    pub(super) tokens: Option<([Tensor; 3], Run)>,
    options: RefineOptions,
    /// Fraction that a step hides.
    pub dropout: f64,
    learns_exposures: bool,
    clear: Run,
    /// Also clears the gradients.
    update: Run,
    schedule: Tensor,
    cleared: bool,
    /// Of the current step.
    inputs: StepInputs,
    lpips: Option<LpipsWeights>,
    steps: u32,
    /// By size, masks and depth.
    plans: PlanCache<[bool; 2], PhotoPlan>,
    batch_size: usize,
}

impl Gaussians {
    pub fn new(arena: &Arena, scene: &Scene, scene_distance: f64, options: &RefineOptions) -> Result<Self> {
        let (device, len) = (arena.device(), scene.len());
        let widths = SceneTensors::widths(scene.sh_degree);
        let mut layout = ResidentLayout::new(device.limits());
        let lay_out = |()| SceneTensors::lay_out(&mut layout, len, scene.sh_degree);
        let tensors @ [values, ..] = [(); 4].map(lay_out);
        let [_, gradients, first, second] = tensors.map(|tensors| tensors.all());
        let memory = Arc::new(Resident::new(device, &layout)?);
        let LearningRates { means, scales, quats, opacities, sh_coeffs, sh_higher, .. } = options.learning_rates;
        let harmonics = Rate { first: sh_coeffs, others: sh_higher, width: widths[4] as u32 };
        let rates = [(means * scene_distance as f32).into(), scales.into(), quats.into(), opacities.into(), harmonics];
        let spaces = [Space::Linear, Space::Log, Space::Linear, Space::Logit, Space::Linear];
        let eps = [MEANS_EPS / scene_distance as f32, EPS, EPS, EPS, EPS];
        let penalties = [0.0, options.scale_penalty / (3.0 * scene_distance as f32), 0.0, 0.0, 0.0];
        let field = |i: usize| Field {
            values: values.all()[i],
            gradient: gradients[i],
            moments: [first[i], second[i]],
            len: widths[i] * len,
            rate: rates[i],
            space: spaces[i],
            eps: eps[i] / len as f32,
            penalty: penalties[i] / len as f32,
        };
        let fields = [0, 1, 2, 3, 4].map(field);
        let (update, schedule) = update(arena, &memory, &fields)?;
        values.write(&memory, &bounded(scene.clone()))?;
        let zero = first.into_iter().chain(second).map(|tensor| (tensor, 0.0));
        filling(arena, &memory, zero)?.execute()?;
        let begin = [0, 1, 2, 3, 4].map(|i| (fields[i].gradient, fields[i].penalty));
        let gaussians = Self::of(arena, options, vec![memory], values, begin, update, schedule)?;
        Ok(Self { fields: fields.into(), ..gaussians })
    }

    pub(super) fn of(
        arena: &Arena,
        options: &RefineOptions,
        memories: Vec<Arc<Resident>>,
        scene: SceneTensors,
        gradients: [(Tensor, f32); 5],
        update: Run,
        schedule: Tensor,
    ) -> Result<Self> {
        let d_scene = SceneTensors::of(gradients.map(|(tensor, _)| tensor), scene.len, scene.sh_degree);
        let clear = filling(arena, &memories[0], gradients.into_iter())?;
        let open = |PerceptualLoss { network, .. }: PerceptualLoss| {
            let device = arena.device();
            LpipsWeights::open(device, network, &Perceptual::file(network, device.cache_dir())?, true)
        };
        let lpips = options.perceptual_loss.map(open).transpose()?;
        let limits = arena.device().limits();
        let capacity = options.intersection_capacity.unwrap_or_else(|| first_capacity(scene.len)).max(1);
        Ok(Self {
            arena: arena.clone(),
            memories,
            fields: Vec::new(),
            scene,
            drawing: RenderOptions::default(),
            gradients: Gradients { scene: Some(d_scene), cameras: None },
            tokens: None,
            options: options.clone(),
            dropout: 0.0,
            learns_exposures: false,
            clear,
            update: update.in_flight()?,
            schedule,
            cleared: false,
            inputs: StepInputs::default(),
            lpips,
            steps: 0,
            plans: PlanCache::new(limits, capacity).holding(PLANS),
            batch_size: batch_size(options, limits),
        })
    }

    pub fn step(&mut self, views: &[&View], [rate, depth_weight]: [f32; 2]) -> Result<Vec<PhotoLoss>> {
        self.inputs =
            StepInputs { depth_weight, dropout_key: Random::nth(self.options.seed, self.steps.into()) as u32 };
        let mut views = views.to_vec();
        views.sort_by_key(|view| view.size);
        let found = loop {
            if !self.cleared {
                self.clear.execute()?;
            }
            if let Some(found) = self.add_all(&views)? {
                break found;
            }
        };
        self.steps += 1;
        self.update.write(self.schedule, &ADAM.schedule(rate, self.steps))?;
        self.update.execute()?;
        self.cleared = true;
        Ok(found)
    }

    /// `None` if the capacity was exceeded; it then grows.
    fn add_all(&mut self, views: &[&View]) -> Result<Option<Vec<PhotoLoss>>> {
        let (mut found, depth_weight) = (Vec::new(), self.inputs.depth_weight);
        for alike in views.chunk_by(|a, b| a.size == b.size) {
            let mut left = alike;
            while !left.is_empty() {
                let [width, height] = left[0].size;
                let pixels = width as usize * height as usize;
                let count = left.len().min(self.batch_size).min(max_batch(pixels));
                let (views, behind) = left.split_at(count);
                match self.run(views, true) {
                    Ok(Some(plan)) => {
                        found.extend(plan.losses(views, depth_weight)?);
                        left = behind;
                    }
                    Ok(None) => return Ok(None),
                    Err(Error::Memory { .. }) if count > 1 => {
                        self.batch_size = 1;
                        self.plans.clear();
                    }
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(Some(found))
    }

    pub fn state(&mut self, state: &mut State<'_>) -> Result<()> {
        let mut steps = self.steps as usize;
        state.count("steps", &mut steps)?;
        self.steps = steps as u32;
        let fields =
            SceneTensors::NAMES.into_iter().zip(self.fields.iter().map(|f| [f.values, f.moments[0], f.moments[1]]));
        for (name, tensors) in fields.chain(self.tokens.iter().map(|(tensors, _)| ("tokens", *tensors))) {
            for (tensor, end) in tensors.into_iter().zip(["", ".first", ".second"]) {
                state.tensor(&format!("{name}{end}"), &self.memories[0], tensor)?;
            }
        }
        match &mut self.tokens {
            Some((_, forward)) if state.loads() => forward.execute().map(drop),
            _ => Ok(()),
        }
    }

    pub fn learn_exposures(&mut self) {
        self.learns_exposures = true;
        self.plans.clear();
    }

    /// Draws with the renderer's defaults for `scene`.
    pub fn draw_as(&mut self, scene: &Scene) {
        self.drawing = RenderOptions::default().for_scene(scene);
    }

    /// Draws a photo's camera: `[height][width][rgb]` and the count of tile intersections.
    pub fn draw(&mut self, view: &View) -> Result<(Vec<f32>, usize)> {
        loop {
            if let Some(PhotoPlan { run, recorded }) = self.run(&[view], false)? {
                return Ok((run.read(recorded.outputs.frames)?, recorded.outputs.needed(run)?));
            }
        }
    }

    /// Runs the plan of photos of one size; `None` after an overflow, which enlarges the next.
    fn run(&mut self, views: &[&View], backward: bool) -> Result<Option<&mut PhotoPlan>> {
        self.cleared &= !backward;
        let inputs = self.inputs;
        let plan = self.plan(views, backward)?;
        plan.write(views, inputs)?;
        plan.run.execute()?;
        let needed = plan.recorded.outputs.needed(&plan.run)?;
        self.plans.fitting(needed)
    }

    pub fn device(&self) -> &Device {
        self.arena.device()
    }

    fn plan(&mut self, views: &[&View], backward: bool) -> Result<&mut PhotoPlan> {
        let [width, height] = views[0].size;
        let shape = FrameShape { cameras: views.len(), width, height };
        let [masked, depth] = [|view: &&View| view.image.mask.is_some(), |view: &&View| view.depth.is_some()]
            .map(|has: fn(&&View) -> bool| backward && views.iter().any(has));
        self.plans.get(PlanKey { shape, backward, options: [masked, depth] }, |capacity| {
            let mut rec = Recorder::new(self.arena.device().limits());
            let lpips = self.lpips.as_ref().map(|weights| &weights.lpips);
            let training = backward.then_some(Training {
                options: &self.options,
                gradients: &self.gradients,
                lpips,
                dropout: self.dropout,
                exposure: self.learns_exposures,
                masked,
                depth,
            });
            let recorded = record_photos(&mut rec, &self.scene, shape, capacity, &self.drawing, training);
            let weights = self.lpips.iter().map(|weights| weights.resident.clone());
            let run = Run::in_arena(&self.arena, 0, rec.finish()?, self.memories.iter().cloned().chain(weights))?;
            // Staging saves a wait per input and output.
            Ok(PhotoPlan { run: run.in_flight()?, recorded })
        })
    }

    /// Allocates a step with one photo, whose exposure is learned if `exposed`.
    pub fn reserve(&mut self, view: &View, exposed: bool) -> Result<()> {
        let learned = self.learns_exposures;
        self.learns_exposures |= exposed;
        let planned = self.plan(&[view], true).map(drop);
        if self.learns_exposures != learned {
            self.learns_exposures = learned;
            self.plans.clear();
        }
        planned
    }

    pub fn scene(&self) -> Result<Scene> {
        let antialiased = self.drawing.antialiased.unwrap_or(false);
        Ok(Scene { antialiased, ..self.scene.read(&self.memories[0])? })
    }

    pub fn show(&self, scene: &Scene) -> Result<()> {
        self.scene.write(&self.memories[0], &bounded(padded(scene, self.scene.len)))
    }

    /// Passes the root mean squares of the means' gradients to `change`, which returns the
    /// Gaussians whose moments reset, or `None` if it changed nothing.
    pub fn edit(&mut self, change: impl FnOnce(&mut Scene, &[f64]) -> Option<Vec<usize>>) -> Result<()> {
        let (mut scene, memory) = (self.scene()?, &self.memories[0]);
        let squares: Vec<[f32; 3]> = memory.read(self.fields[0].moments[1])?;
        let root = |squares: &[f32; 3]| squares.iter().copied().map(f64::from).sum::<f64>().sqrt();
        let roots: Vec<f64> = squares.iter().map(root).collect();
        let Some(changed) = change(&mut scene, &roots) else { return Ok(()) };
        let count = scene.len();
        self.scene.write(memory, &bounded(scene))?;
        for Field { moments, len, .. } in &self.fields {
            let width = len / count;
            for moment in moments {
                let mut values: Vec<f32> = memory.read(*moment)?;
                changed.iter().for_each(|i| values[i * width..(i + 1) * width].fill(0.0));
                memory.write(*moment, &values)?;
            }
        }
        Ok(())
    }

    pub fn profile(&mut self, views: &[&View]) -> Result<Profile> {
        let size = views[0].size;
        let most = self.batch_size.min(max_batch(size[0] as usize * size[1] as usize));
        let alike: Vec<&View> = views.iter().copied().filter(|view| view.size == size).take(most).collect();
        // Until no intersection overflows.
        while self.run(&alike, true)?.is_none() {}
        let inputs = self.inputs;
        let plan = self.plan(&alike, true)?;
        plan.write(&alike, inputs)?;
        let mut profile = plan.run.profile()?;
        self.update.write(self.schedule, &ADAM.schedule(0.0, self.steps.max(1)))?;
        profile.rows.extend(self.update.profile()?.rows);
        Ok(profile)
    }
}

pub(super) fn batch_size(options: &RefineOptions, limits: &Limits) -> usize {
    let usual = if limits.cpu || options.perceptual_loss.is_some() { 1 } else { options.views_per_step };
    options.batch_size.filter(|_| options.perceptual_loss.is_none()).unwrap_or(usual).max(1)
}

pub(super) fn max_batch(pixels: usize) -> usize {
    (MAX_BATCH_PIXELS / pixels).max(1)
}

/// Clamps stored values to their spaces.
fn bounded(mut scene: Scene) -> Scene {
    scene.scales.as_flattened_mut().iter_mut().for_each(|scale| *scale = scale.max(LEAST_SCALE));
    scene.quats.iter_mut().for_each(|quat| *quat = unit_quaternion(*quat));
    let between = |opacity: f32| opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN);
    scene.opacities.iter_mut().for_each(|opacity| *opacity = between(*opacity));
    scene
}

pub(super) fn filling(
    arena: &Arena,
    memory: &Arc<Resident>,
    fills: impl Iterator<Item = (Tensor, f32)>,
) -> Result<Run> {
    let mut rec = Recorder::new(arena.device().limits());
    record_fills(&mut rec, fills);
    Run::in_arena(arena, 0, rec.finish()?, [memory.clone()])
}

pub(super) fn record_fills(rec: &mut Recorder, fills: impl Iterator<Item = (Tensor, f32)>) {
    fills.for_each(|(tensor, value)| rec.fill(tensor, value.to_bits()));
}

fn update(arena: &Arena, memory: &Arc<Resident>, fields: &[Field]) -> Result<(Run, Tensor)> {
    let mut rec = Recorder::new(arena.device().limits());
    let schedule = rec.input::<f32>("schedule", 4);
    rec.scope("adam", |rec| {
        for Field { values, gradient, moments, len, rate, space, eps, .. } in fields {
            record_adam(rec, Adam { eps: *eps, ..ADAM }, *values, *gradient, *moments, schedule, *rate, *space, *len);
        }
    });
    let Field { values: scales, len, rate, .. } = &fields[1];
    let rate = LIMIT_RATE * rate.first;
    rec.scope("anisotropy", |rec| record_anisotropy_limit(rec, *scales, schedule, MAX_ANISOTROPY, rate, len / 3));
    record_fills(&mut rec, fields.iter().map(|field| (field.gradient, field.penalty)));
    Ok((Run::in_arena(arena, 0, rec.finish()?, [memory.clone()])?, schedule))
}
