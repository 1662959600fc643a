//! Optimization of scene tokens through the frozen head.
//!
//! Source: ZipSplat, section 4.2, "Test-time optimization".

use super::{
    RefineOptions, Space,
    gaussians::{ADAM, Gaussians, filling, record_fills},
    record_adam,
};
use crate::{
    Error, Result,
    gpu::{Arena, Device, Recorder, Resident, ResidentLayout, Run},
    ops::ParameterLayout,
    reconstruct::SceneTokens,
    stages::{SceneTensors, gaussians::Head},
    tune::KernelChoice,
    types::Scene,
    weights::{Architecture, Checkpoint},
};
use std::{ops::ControlFlow, sync::Arc};

/// A model's f32 head on a device, forward and backward.
pub struct FrozenHead {
    head: Head,
    architecture: Architecture,
    memory: Arc<Resident>,
}

impl FrozenHead {
    /// Loads the head of a checkpoint.
    ///
    /// # Errors
    /// [`Error::Memory`] if the device has too little; an unreadable checkpoint.
    pub fn load(device: &Device, checkpoint: &Checkpoint) -> Result<Self> {
        let architecture = checkpoint.architecture().clone();
        let arithmetic = KernelChoice::exact(device);
        let mut parameters = ParameterLayout::new(device.limits(), arithmetic);
        let head = Head::new(&mut parameters, &architecture);
        let memory = parameters.load(device, &**checkpoint, |_| ControlFlow::Continue(()))?.resident;
        Ok(Self { head, architecture, memory })
    }
}

pub(super) fn gaussians(
    arena: &Arena,
    head: &FrozenHead,
    tokens: &SceneTokens,
    options: &RefineOptions,
) -> Result<(Gaussians, Scene)> {
    let FrozenHead { head, architecture: a, memory: weights } = head;
    let device = arena.device();
    let (count, width) = (tokens.count(), a.width + a.color_width);
    if tokens.width() != width {
        return Err(Error::argument("width of the tokens", tokens.width(), format!("{width}, as the head's")));
    }
    let (len, sh_degree) = (count * a.gaussians_per_token, a.sh_degree as u32);
    let mut layout = ResidentLayout::new(device.limits());
    let [scene, d_scene] = [(); 2].map(|()| SceneTensors::lay_out(&mut layout, len, sh_degree));
    let [moved, first, second] = [(); 3].map(|()| layout.add::<f32>(count * width));
    let scene_scale = layout.add::<f32>(1);
    let kept = head.keep(&mut layout, count, scene_scale);
    let memory = Arc::new(Resident::new(device, &layout)?);
    memory.write(scene_scale, &[tokens.scene_scale() as f32])?;
    filling(arena, &memory, [(first, 0.0), (second, 0.0)].into_iter())?.execute()?;

    // Once: the Gaussians of a copy of the tokens.
    let mut rec = Recorder::new(device.limits());
    rec.copy(tokens.tensor(), moved);
    Run::in_arena(arena, 0, rec.finish()?, [memory.clone(), tokens.resident().clone()])?.execute()?;
    let mut rec = Recorder::new(device.limits());
    head.record_kept(&mut rec, moved, &kept, &scene);
    let mut forward = Run::in_arena(arena, 0, rec.finish()?, [memory.clone(), weights.clone()])?;
    forward.execute()?;

    // Every step: backward through the last run, then forward again.
    let mut rec = Recorder::new(device.limits());
    let schedule = rec.input::<f32>("schedule", 4);
    let d_tokens = head.record_backward(&mut rec, &kept, &d_scene);
    rec.scope("adam", |rec| {
        let (rate, len) = (options.learning_rates.tokens, count * width);
        record_adam(rec, ADAM, moved, d_tokens, [first, second], schedule, rate, Space::Linear, len);
    });
    head.record_kept(&mut rec, moved, &kept, &scene);
    let gradients = d_scene.all().map(|gradient| (gradient, 0.0));
    record_fills(&mut rec, gradients.into_iter());
    let memories = vec![memory, weights.clone()];
    let update = Run::in_arena(arena, 0, rec.finish()?, memories.iter().cloned())?;

    let mut gaussians = Gaussians::of(arena, options, memories, scene, gradients, update, schedule)?;
    gaussians.tokens = Some(([moved, first, second], forward));
    let scene = gaussians.scene()?;
    Ok((gaussians, scene))
}
