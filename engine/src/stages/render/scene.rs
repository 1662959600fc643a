use super::{RenderOptions, SceneTensors, range::drawable};
use crate::stages::coeffs_of;
use crate::{
    Result,
    gpu::{Arena, Device, Resident, ResidentLayout},
    types::{Pose, Scene},
};
use std::sync::{Arc, Weak};

/// Shared, immutable Gaussians on a device.
#[derive(Clone)]
pub struct DeviceScene(Arc<Gaussians>);

/// A scene for [`Renderer::set_scene`](super::Renderer::set_scene).
#[derive(Clone, Copy, Debug)]
pub enum SceneSource<'a> {
    Host(&'a Scene),
    /// With the pose of its frame in the scene's world, if they differ.
    Device(&'a DeviceScene, Option<Pose>),
}

impl<'a> From<&'a Scene> for SceneSource<'a> {
    fn from(scene: &'a Scene) -> Self {
        Self::Host(scene)
    }
}

impl<'a> From<&'a DeviceScene> for SceneSource<'a> {
    fn from(scene: &'a DeviceScene) -> Self {
        Self::Device(scene, None)
    }
}

struct Gaussians {
    memory: Arc<Resident>,
    tensors: SceneTensors,
    arena: Option<Arena>,
    /// Source degree; bands above [`SceneTensors::sh_degree`] are zero.
    stored_degree: u32,
    near: f32,
    antialiased: bool,
}

impl std::fmt::Debug for DeviceScene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "DeviceScene of {} Gaussians", self.len())
    }
}

/// Reusable memory of one scene.
pub struct SceneMemory {
    memory: Arc<Resident>,
    tensors: SceneTensors,
    arena: Option<Arena>,
    user: Weak<Gaussians>,
}

impl SceneMemory {
    pub fn new(device: &Device, layout: &ResidentLayout, tensors: SceneTensors) -> Result<Self> {
        let memory = Arc::new(Resident::new(device, layout)?);
        Ok(Self { memory, tensors, arena: None, user: Weak::new() })
    }

    /// Sets the renderers' arena.
    pub fn made_in(mut self, arena: &Arena) -> Self {
        self.arena = Some(arena.clone());
        self
    }

    pub fn is_free(&self) -> bool {
        self.user.strong_count() == 0
    }

    pub fn resident(&self) -> &Arc<Resident> {
        &self.memory
    }

    /// Hides the Gaussians of other tokens, if given.
    pub fn show_tokens(&self, tokens: Option<&[usize]>, count: usize) -> Result<()> {
        let Some(tokens) = tokens else { return Ok(()) };
        let all: Vec<f32> = self.memory.read(self.tensors.opacities)?;
        let (each, mut opacities) = (all.len() / count, vec![0.0; all.len()]);
        for token in tokens.iter().map(|token| token * each..(token + 1) * each) {
            opacities[token.clone()].copy_from_slice(&all[token]);
        }
        self.memory.write(self.tensors.opacities, &opacities)
    }

    /// Returns the written scene. Panics if the previous one exists.
    pub fn scene(&mut self, stored_degree: u32, near: f32, antialiased: bool) -> DeviceScene {
        assert!(self.is_free(), "a scene in use was overwritten");
        let (memory, arena) = (self.memory.clone(), self.arena.clone());
        let tensors = self.tensors;
        let gaussians = Arc::new(Gaussians { memory, tensors, arena, stored_degree, near, antialiased });
        self.user = Arc::downgrade(&gaussians);
        DeviceScene(gaussians)
    }

    /// Uploads a scene without zero SH bands.
    pub fn write(&mut self, scene: &Scene) -> Result<DeviceScene> {
        let Self { memory, tensors, .. } = self;
        memory.write(tensors.means, &scene.means)?;
        memory.write(tensors.scales, &scene.scales)?;
        memory.write(tensors.quats, &drawable(&scene.quats))?;
        memory.write(tensors.opacities, &scene.opacities)?;
        if tensors.sh_degree == scene.sh_degree {
            memory.write(tensors.sh_coeffs, &scene.sh_coeffs)?;
        } else {
            let used = coeffs_of(tensors.sh_degree);
            let coeffs = scene.sh_coeffs.chunks_exact(scene.sh_coeffs_per_gaussian()).flat_map(|all| &all[..used]);
            memory.write(tensors.sh_coeffs, &coeffs.copied().collect::<Vec<_>>())?;
        }
        Ok(self.scene(scene.sh_degree, scene.near(), scene.antialiased))
    }

    pub fn tensors(&self) -> &SceneTensors {
        &self.tensors
    }
}

impl DeviceScene {
    pub fn read(&self) -> Result<Scene> {
        Ok(Scene { antialiased: self.0.antialiased, ..self.0.tensors.read(&self.0.memory)? })
    }

    pub fn len(&self) -> usize {
        self.0.tensors.len
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn bytes(&self) -> u64 {
        self.0.memory.bytes()
    }

    pub fn tensors(&self) -> &SceneTensors {
        &self.0.tensors
    }

    pub fn resident(&self) -> &Arc<Resident> {
        &self.0.memory
    }

    pub(super) fn arena(&self) -> Option<&Arena> {
        self.0.arena.as_ref()
    }

    pub fn fill_in(&self, options: &RenderOptions) -> RenderOptions {
        options.with_defaults(self.0.near, self.0.antialiased)
    }

    pub(super) fn stored_degree(&self) -> u32 {
        self.0.stored_degree
    }
}

pub fn used_degree(scene: &Scene) -> u32 {
    let stride = scene.sh_coeffs_per_gaussian();
    let zero = |degree: u32| {
        let band = (degree as usize).pow(2)..(degree as usize + 1).pow(2);
        scene.sh_coeffs.chunks_exact(stride).all(|coeffs| coeffs[band.clone()].iter().all(|rgb| *rgb == [0.0; 3]))
    };
    (1..=scene.sh_degree).rev().find(|&degree| !zero(degree)).unwrap_or(0)
}
