//! Gaussians on a device.

use super::{SceneTensors, range::drawable};
use crate::stages::coeffs_of;
use crate::{
    Result,
    gpu::{Arena, Device, Resident, ResidentLayout},
    types::Scene,
};
use std::sync::{Arc, Weak};

/// Gaussians on a device, for a [`Renderer`](super::Renderer) to draw and for the host to read. Cloning shares them; they never
/// change while anybody has them.
#[derive(Clone)]
pub struct DeviceScene(Arc<Gaussians>);

/// A [`DeviceScene`] that does not keep the Gaussians on the device.
#[derive(Clone)]
pub struct WeakScene(Weak<Gaussians>);

impl WeakScene {
    /// The scene, while somebody else keeps it.
    pub fn upgrade(&self) -> Option<DeviceScene> {
        self.0.upgrade().map(DeviceScene)
    }
}

struct Gaussians {
    memory: Arc<Resident>,
    tensors: SceneTensors,
    /// Where a reconstruction made them.
    arena: Option<Arena>,
    /// The degree of the scene that they were made of, whose bands above [`SceneTensors::sh_degree`] are all zero.
    stored_degree: u32,
    /// Distance below which it is not drawn.
    near: f32,
}

impl std::fmt::Debug for DeviceScene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "DeviceScene of {} Gaussians", self.len())
    }
}

/// A scene's memory, which takes one scene after the other: the next one when nobody has the last one any more.
pub struct SceneMemory {
    memory: Arc<Resident>,
    tensors: SceneTensors,
    arena: Option<Arena>,
    user: Weak<Gaussians>,
}

impl SceneMemory {
    /// Room for the tensors of a layout.
    ///
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory) where the device has too little.
    pub fn new(device: &Device, layout: &ResidentLayout, tensors: SceneTensors) -> Result<Self> {
        let memory = Arc::new(Resident::new(device, layout)?);
        Ok(Self { memory, tensors, arena: None, user: Weak::new() })
    }

    /// Lets renderers draw its scenes in this arena, in which they are made.
    pub fn made_in(mut self, arena: &Arena) -> Self {
        self.arena = Some(arena.clone());
        self
    }

    /// Whether nobody has the scene that lies here.
    pub fn is_free(&self) -> bool {
        self.user.strong_count() == 0
    }

    /// The memory, for a plan to write.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.memory
    }

    /// The scene that was written here, its near plane [`Scene::near`].
    ///
    /// # Panics
    /// Where somebody has the scene that was here before.
    pub fn scene(&mut self, stored_degree: u32, near: f32) -> DeviceScene {
        assert!(self.is_free(), "a scene in use was overwritten");
        let (memory, arena) = (self.memory.clone(), self.arena.clone());
        let gaussians = Arc::new(Gaussians { memory, tensors: self.tensors, arena, stored_degree, near });
        self.user = Arc::downgrade(&gaussians);
        DeviceScene(gaussians)
    }

    /// Writes a scene whose bands above that of the tensors are all zero.
    ///
    /// # Errors
    /// A transfer that fails.
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
        Ok(self.scene(scene.sh_degree, scene.near()))
    }

    /// The tensors that lie here.
    pub fn tensors(&self) -> &SceneTensors {
        &self.tensors
    }
}

impl DeviceScene {
    /// The Gaussians, on the host.
    ///
    /// # Errors
    /// A transfer that fails.
    pub fn read(&self) -> Result<Scene> {
        self.0.tensors.read(&self.0.memory)
    }

    /// The same scene without a hold on it.
    pub fn downgrade(&self) -> WeakScene {
        WeakScene(Arc::downgrade(&self.0))
    }

    /// Gaussians.
    pub fn len(&self) -> usize {
        self.0.tensors.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Their bytes on the device.
    pub fn bytes(&self) -> u64 {
        self.0.memory.bytes()
    }

    /// The tensors, in [`DeviceScene::resident`].
    pub fn tensors(&self) -> &SceneTensors {
        &self.0.tensors
    }

    /// The memory that a plan with these tensors runs with.
    pub fn resident(&self) -> &Arc<Resident> {
        &self.0.memory
    }

    /// The arena that they were made in.
    pub(super) fn arena(&self) -> Option<&Arena> {
        self.0.arena.as_ref()
    }

    /// The distance from a camera below which it is not drawn.
    pub(super) fn near(&self) -> f32 {
        self.0.near
    }

    /// The degree of the spherical harmonics that the scene was stored with.
    pub(super) fn stored_degree(&self) -> u32 {
        self.0.stored_degree
    }
}

/// Degree of the highest band that is not all zero: what is above it is neither stored nor evaluated.
pub(super) fn used_degree(scene: &Scene) -> u32 {
    let stride = scene.sh_coeffs_per_gaussian();
    let zero = |degree: u32| {
        let band = (degree as usize).pow(2)..(degree as usize + 1).pow(2);
        scene.sh_coeffs.chunks_exact(stride).all(|coeffs| coeffs[band.clone()].iter().all(|rgb| *rgb == [0.0; 3]))
    };
    (1..=scene.sh_degree).rev().find(|&degree| !zero(degree)).unwrap_or(0)
}
