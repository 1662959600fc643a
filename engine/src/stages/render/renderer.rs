use super::{
    CameraRows, DeviceScene, FrameShape, PixelLayout, PlanCache, PlanKey, RenderOptions, RenderOutput, SceneMemory,
    SceneTensors, camera_rows, first_capacity,
    planned::{Destination, RenderKey, RenderPlan, batch_size},
    range::check,
    scene::{SceneSource, used_degree},
};
use crate::{
    Error, Result,
    gpu::{Arena, Claim, Device, Limits, Profile, ResidentLayout, Target},
    types::{Camera, Scene, SkippedPass},
};
use std::collections::BTreeMap;

/// Renders scenes on one device, replaying cached plans in a shared arena.
pub struct Renderer {
    arena: Arena,
    scene: Option<DeviceScene>,
    uploaded: Option<SceneMemory>,
    pub(super) plans: PlanCache<(RenderOptions, Destination), RenderPlan>,
    /// As given; 0 derives it from the scene.
    initial_capacity: usize,
    pub(super) intersections: usize,
    cameras_at_once: usize,
    pub(super) batch_size: usize,
}

impl Renderer {
    /// Creates an empty renderer.
    pub fn new(device: &Device) -> Self {
        Self::with_capacity(device, 0)
    }

    /// Sets the initial intersections per image; 0 derives them.
    pub fn with_capacity(device: &Device, capacity: usize) -> Self {
        Self { initial_capacity: capacity, ..Self::in_arena(&Arena::new(device)) }
    }

    /// Creates a renderer in a shared arena, or its own if busy.
    pub fn in_arena(arena: &Arena) -> Self {
        Self {
            arena: arena.clone(),
            scene: None,
            uploaded: None,
            plans: PlanCache::new(arena.device().limits(), 0),
            initial_capacity: 0,
            intersections: 0,
            cameras_at_once: usize::MAX,
            batch_size: batch_size(arena.device().limits()),
        }
    }

    /// Device.
    pub fn device(&self) -> &Device {
        self.arena.device()
    }

    /// Sets the largest batch of [`Renderer::render_each`].
    pub fn batch_size(mut self, most: usize) -> Self {
        self.batch_size = most.max(1);
        self
    }

    /// Sets the scene and renders it with each camera.
    pub fn render_scene(
        &mut self,
        scene: &Scene,
        cameras: &[Camera],
        options: &RenderOptions,
    ) -> Result<Vec<RenderOutput>> {
        self.set_scene(scene)?;
        self.render(cameras, options)
    }

    /// Uploads a [`Scene`]; uses a [`DeviceScene`], or a reconstruction in its first camera's
    /// frame, in place.
    ///
    /// # Errors
    /// [`Error::Argument`] for an invalid scene or another device's; [`Error::DeviceLost`].
    pub fn set_scene<'a>(&mut self, scene: impl Into<SceneSource<'a>>) -> Result<()> {
        match scene.into() {
            SceneSource::Host(scene) => self.upload(scene),
            SceneSource::Device(scene, None) => self.show(scene),
            SceneSource::Device(scene, Some(pose)) => {
                let mut scene = scene.read()?;
                scene.place(1.0, &pose);
                self.upload(&scene)
            }
        }
    }

    fn upload(&mut self, scene: &Scene) -> Result<()> {
        scene.validate()?;
        self.scene = None;
        let degree = used_degree(scene);
        let fits = |memory: &SceneMemory| {
            (memory.tensors().len, memory.tensors().sh_degree) == (scene.len(), degree) && memory.is_free()
        };
        let memory = match self.uploaded.take().filter(fits) {
            Some(memory) => memory,
            None => {
                // Plans keep the previous scene alive.
                self.forget_plans();
                self.allocate(scene.len(), degree)?
            }
        };
        let scene = self.uploaded.insert(memory).write(scene)?;
        self.show(&scene)
    }

    fn show(&mut self, scene: &DeviceScene) -> Result<()> {
        self.device().check_lost()?;
        if !scene.resident().is_on(self.arena.device()) {
            return Err(Error::argument("scene to render", "one on another device", "one on the renderer's device"));
        }
        if let Some(arena) = scene.arena()
            && !self.arena.is(arena)
        {
            self.plans.clear();
            self.arena = arena.clone();
        }
        if self.plans.iter_mut().any(|plan| plan.scene != *scene.tensors()) {
            self.forget_plans();
        }
        self.plans.iter_mut().for_each(|plan| plan.run.replace_resident(scene.resident().clone()));
        self.scene = Some(scene.clone());
        Ok(())
    }

    /// The scene, once set.
    pub fn scene(&self) -> Option<&DeviceScene> {
        self.scene.as_ref()
    }

    /// Renders the scene with each camera.
    ///
    /// # Errors
    /// [`Error::Argument`] for invalid input or no scene; [`Error::Memory`] if one image does not
    /// fit.
    pub fn render(&mut self, cameras: &[Camera], options: &RenderOptions) -> Result<Vec<RenderOutput>> {
        check(cameras, options)?;
        let _claim = self.claim();
        let mut by_size = BTreeMap::<(u32, u32), Vec<usize>>::new();
        for (i, camera) in cameras.iter().enumerate() {
            by_size.entry((camera.intrinsics.width, camera.intrinsics.height)).or_default().push(i);
        }
        let mut frames: Vec<Option<RenderOutput>> = cameras.iter().map(|_| None).collect();
        for (size, indices) in by_size {
            let rows: Vec<CameraRows> = indices.iter().map(|&i| camera_rows(&cameras[i])).collect();
            let drawn = self.render_alike(&rows, size, options, Destination::Host(0))?;
            for (index, frame) in indices.into_iter().zip(drawn) {
                frames[index] = Some(frame);
            }
        }
        Ok(frames.into_iter().flatten().collect())
    }

    /// Intersections of the last rendering.
    pub fn intersections(&self) -> usize {
        self.intersections
    }

    /// Intersections per image of new plans; 0 before the first.
    pub fn capacity(&self) -> usize {
        self.plans.capacity
    }

    /// Skipped effects, with reasons.
    pub fn skipped_passes(&self, options: &RenderOptions) -> Vec<SkippedPass> {
        let Some(scene) = &self.scene else { return options.skipped_passes(0, 0) };
        scene.fill_in(options).skipped_passes(scene.stored_degree(), scene.tensors().sh_degree)
    }

    /// Renders into an application's image or buffer. The copy is only submitted; the next
    /// rendering of this size waits for it.
    pub fn render_to(
        &mut self,
        camera: &Camera,
        options: &RenderOptions,
        layout: PixelLayout,
        target: &Target,
    ) -> Result<()> {
        let options = RenderOptions {
            alpha: true,
            background: options.background,
            antialiased: options.antialiased,
            near: options.near,
            ..RenderOptions::default()
        };
        check(std::slice::from_ref(camera), &options)?;
        let _claim = self.claim();
        let plan = self.drawn(camera, &options, Destination::Device(layout))?;
        plan.run.present(plan.outputs.frames, target)
    }

    /// Profiles one camera by kernel.
    pub fn profile(&mut self, camera: &Camera, options: &RenderOptions) -> Result<Profile> {
        check(std::slice::from_ref(camera), options)?;
        let _claim = self.claim();
        let plan = self.drawn(camera, options, Destination::Host(0))?;
        plan.run.write(plan.cameras, &[camera_rows(camera)])?;
        plan.run.profile()
    }

    /// Draws one picture and returns its plan.
    fn drawn(&mut self, camera: &Camera, options: &RenderOptions, destination: Destination) -> Result<&mut RenderPlan> {
        let shape = FrameShape::of(camera);
        self.render_alike(&[camera_rows(camera)], (shape.width, shape.height), options, destination)?;
        self.plan(shape, options, destination)
    }

    pub(super) fn render_alike(
        &mut self,
        cameras: &[CameraRows],
        size: (u32, u32),
        options: &RenderOptions,
        destination: Destination,
    ) -> Result<Vec<RenderOutput>> {
        let bytes_each = [12 * self.gaussians(), 4 * options.channels() * size.0 as usize * size.1 as usize];
        let bindable = self.limits().max_binding_bytes as usize / bytes_each[0].max(bytes_each[1]);
        let most = bindable.clamp(1, self.limits().max_groups[2] as usize);
        let (mut frames, mut left) = (Vec::with_capacity(cameras.len()), cameras);
        let mut others = true;
        while !left.is_empty() {
            let (batch, behind) = left.split_at(left.len().min(self.cameras_at_once).min(most));
            match self.render_batch(batch, size, options, destination) {
                Ok(drawn) => {
                    frames.extend(drawn);
                    left = behind;
                }
                Err(Error::Memory { .. }) if batch.len() > 1 => {
                    self.cameras_at_once = batch.len() / 2;
                    self.plans.capacity = 0;
                }
                Err(Error::Memory { .. }) if others => {
                    others = false;
                    self.start_over()?;
                }
                Err(error) => return Err(error),
            }
        }
        Ok(frames)
    }

    pub(super) fn render_batch(
        &mut self,
        cameras: &[CameraRows],
        (width, height): (u32, u32),
        options: &RenderOptions,
        destination: Destination,
    ) -> Result<Vec<RenderOutput>> {
        let shape = FrameShape { cameras: cameras.len(), width, height };
        let (key, scene) = self.key(shape, options, destination)?;
        let record = |capacity| RenderPlan::new(&self.arena, &scene, key, capacity);
        let plan = self.plans.run(key, record, |plan| {
            plan.run.write(plan.cameras, cameras)?;
            plan.run.execute()?;
            self.intersections = plan.outputs.needed(&plan.run)?;
            Ok(self.intersections)
        })?;
        plan.read()
    }

    pub(super) fn plan(
        &mut self,
        shape: FrameShape,
        options: &RenderOptions,
        destination: Destination,
    ) -> Result<&mut RenderPlan> {
        let (key, scene) = self.key(shape, options, destination)?;
        self.plans.get(key, |capacity| RenderPlan::new(&self.arena, &scene, key, capacity))
    }

    fn key(
        &mut self,
        shape: FrameShape,
        options: &RenderOptions,
        destination: Destination,
    ) -> Result<(RenderKey, DeviceScene)> {
        let none = || Error::argument("scene to render", "none", "one that was loaded before");
        let scene = self.scene.clone().ok_or_else(none)?;
        if self.plans.capacity == 0 {
            let derived = first_capacity(scene.len());
            self.plans.capacity = if self.initial_capacity == 0 { derived } else { self.initial_capacity };
        }
        Ok((PlanKey { shape, backward: false, options: (scene.fill_in(options), destination) }, scene))
    }

    fn forget_plans(&mut self) {
        self.plans.clear();
        self.plans.capacity = 0;
        self.cameras_at_once = usize::MAX;
    }

    fn allocate(&mut self, len: usize, sh_degree: u32) -> Result<SceneMemory> {
        let mut layout = ResidentLayout::new(self.limits());
        let tensors = SceneTensors::lay_out(&mut layout, len, sh_degree);
        match SceneMemory::new(self.arena.device(), &layout, tensors) {
            Err(Error::Memory { .. }) => {
                let _claim = self.claim();
                self.arena.release()?;
                SceneMemory::new(self.arena.device(), &layout, tensors)
            }
            found => found,
        }
    }

    pub(super) fn start_over(&mut self) -> Result<()> {
        self.plans.clear();
        self.plans.capacity = 0;
        self.arena.release()
    }

    pub(super) fn claim(&mut self) -> Claim {
        if let Some(claim) = self.arena.claim() {
            return claim;
        }
        self.plans.clear();
        self.arena = Arena::new(self.arena.device());
        self.arena.claim().expect("nobody else knows it")
    }

    fn limits(&self) -> &Limits {
        self.arena.device().limits()
    }

    pub(super) fn gaussians(&self) -> usize {
        self.scene.as_ref().map_or(0, DeviceScene::len)
    }

    pub(super) fn settle(&mut self) -> Result<()> {
        self.plans.iter_mut().try_for_each(|plan| plan.run.finish())
    }
}
