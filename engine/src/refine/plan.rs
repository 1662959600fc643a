use super::{
    Adam, Exposure, RefineLength, RefineOptions, Space, filled,
    gaussians::{batch_size, max_batch},
    length::{dropout, grown_len},
    planned::{Training, record_photos},
    record_adam,
    schedule::Schedule,
    tokens_grow_not,
    views::fitted,
};
use crate::{
    Result,
    gpu::{Arena, Limits, Plan, Recorder, ResidentLayout, Tensor},
    ops::{Arithmetic, ParameterLayout},
    perceptual::LpipsWeights,
    stages::{
        Architecture,
        gaussians::Head,
        render::{FrameShape, Gradients, RenderOptions, SceneTensors, first_capacity, planned_capacity},
    },
};

/// Optimized parameters.
#[derive(Clone, Copy, Debug)]
pub enum Moved<'a> {
    /// Number of Gaussians and their SH degree.
    Gaussians(usize, u32),
    /// Number of tokens, and the network of their head.
    Tokens(usize, &'a Architecture),
}

/// Memory plan of a refinement.
pub struct RefinePlan {
    /// Persistent bytes: Gaussians, gradients and moments.
    pub kept_bytes: u64,
    /// Plans of a step, which share the arena.
    pub plans: Vec<Plan>,
}

impl RefinePlan {
    /// Bytes of a separate arena.
    pub fn arena_bytes(&self) -> u64 {
        Arena::lane_bytes(&self.plans)
    }
}

/// Plans a refinement against `photos` photos of `[width, height]` pixels without a device.
/// [`Exposure::Auto`] is planned as [`Exposure::Off`].
///
/// # Errors
/// [`Error::Argument`](crate::Error::Argument) if all photos are held out or tokens are to grow.
pub fn plan_refinement(
    limits: &Limits,
    moved: Moved<'_>,
    photos: usize,
    [width, height]: [u32; 2],
    masked: bool,
    options: &RefineOptions,
) -> Result<RefinePlan> {
    let options = filled(options, photos)?;
    let training = photos - options.holdout_views.unwrap_or(0);
    if let Moved::Tokens(..) = moved {
        tokens_grow_not(&options)?;
    }
    let (len, sh_degree) = match moved {
        Moved::Gaussians(len, sh_degree) => {
            let sizes = std::iter::repeat_n(fitted([width, height], options.max_image_size, 1), photos);
            (grown_len(&options, options.length.most_steps(), len, sizes).unwrap_or(len), sh_degree)
        }
        Moved::Tokens(count, a) => (count * a.gaussians_per_token, a.sh_degree as u32),
    };
    let mut layout = ResidentLayout::new(limits);
    let [scene, d_scene] = [(); 2].map(|()| SceneTensors::lay_out(&mut layout, len, sh_degree));
    let mut plans = Vec::new();
    let mut kept_bytes = 0;
    match moved {
        Moved::Gaussians(..) => {
            let moments = [(); 2].map(|()| SceneTensors::lay_out(&mut layout, len, sh_degree).all());
            let mut rec = Recorder::new(limits);
            let schedule = rec.input::<f32>("schedule", 4);
            for (i, width) in SceneTensors::widths(sh_degree).into_iter().enumerate() {
                let moments = [moments[0][i], moments[1][i]];
                adam(&mut rec, scene.all()[i], d_scene.all()[i], moments, schedule, width * len);
            }
            plans.push(rec.finish()?);
        }
        Moved::Tokens(count, a) => {
            let mut parameters = ParameterLayout::new(limits, Arithmetic::EXACT);
            let head = Head::new(&mut parameters, a);
            let width = count * (a.width + a.color_width);
            let [tokens, first, second] = [(); 3].map(|()| layout.add::<f32>(width));
            let scene_scale = layout.add::<f32>(1);
            let kept = head.keep(&mut layout, count, scene_scale);
            let mut rec = Recorder::new(limits);
            let schedule = rec.input::<f32>("schedule", 4);
            let d_tokens = head.record_backward(&mut rec, &kept, &d_scene);
            adam(&mut rec, tokens, d_tokens, [first, second], schedule, width);
            head.record_kept(&mut rec, tokens, &kept, &scene);
            plans.push(rec.finish()?);
            let mut given = ResidentLayout::new(limits);
            given.add::<f32>(width);
            kept_bytes += parameters.bytes() + given.bytes();
        }
    }
    kept_bytes += layout.bytes();

    let weights =
        options.perceptual_loss.map(|loss| LpipsWeights::layout(limits, Arithmetic::EXACT, loss.network, true));
    kept_bytes += weights.as_ref().map_or(0, |(parameters, _)| parameters.bytes());
    let lpips = weights.as_ref().map(|(_, lpips)| lpips);
    let gradients = Gradients { scene: Some(d_scene), cameras: None };
    let exposure = options.exposure == Exposure::On;
    let dropout = match (moved, options.length) {
        (Moved::Tokens(..), _) => 0.0,
        (_, RefineLength::Steps(steps)) => dropout(&options, steps as f64, training),
        (_, RefineLength::Time(_)) => dropout(&options, f64::INFINITY, training),
    };
    let training = Training { options: &options, gradients: &gradients, lpips, dropout, exposure, masked, depth: true };
    record_steps(limits, &mut plans, &scene, [width, height], training)?;
    Ok(RefinePlan { kept_bytes, plans })
}

fn record_steps(
    limits: &Limits,
    plans: &mut Vec<Plan>,
    scene: &SceneTensors,
    [width, height]: [u32; 2],
    training: Training<'_>,
) -> Result<()> {
    let options = training.options;
    let photo_size = |factor| fitted([width, height], options.max_image_size, factor);
    let steps = options.length.most_steps();
    let schedule = Schedule { steps, coarse: options.coarse_to_fine };
    let shortest = photo_size(1).into_iter().min().unwrap_or(0);
    let each = options.intersection_capacity.unwrap_or_else(|| first_capacity(scene.len)).max(1);
    let mut factors: Vec<u32> = (0..steps).map(|step| schedule.factor(step, shortest)).collect();
    factors.dedup();
    for factor in factors {
        let [width, height] = photo_size(factor);
        let pixels = width as usize * height as usize;
        let cameras = batch_size(options, limits).min(options.views_per_step).min(max_batch(pixels));
        let shape = FrameShape { cameras, width, height };
        let mut rec = Recorder::new(limits);
        let capacity = planned_capacity(limits.max_binding_bytes, each, shape, true);
        record_photos(&mut rec, scene, shape, capacity, &RenderOptions::default(), Some(training));
        plans.push(rec.finish()?);
    }
    let [width, height] = photo_size(1);
    let mut rec = Recorder::new(limits);
    let shape = FrameShape { cameras: 1, width, height };
    let capacity = planned_capacity(limits.max_binding_bytes, each, shape, false);
    record_photos(&mut rec, scene, shape, capacity, &RenderOptions::default(), None);
    plans.push(rec.finish()?);
    Ok(())
}

fn adam(rec: &mut Recorder, values: Tensor, gradient: Tensor, moments: [Tensor; 2], schedule: Tensor, len: usize) {
    record_adam(rec, Adam::default(), values, gradient, moments, schedule, 1.0, Space::Linear, len);
}
