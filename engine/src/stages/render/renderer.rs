//! Draws a scene again and again: keeps it on the device, and keeps plans.

use super::{
    CameraRows, DeviceScene, Frame, FrameShape, PixelLayout, RenderRequest, SceneMemory, SceneTensors, camera_rows,
    planned::{Key, Planned, first_capacity, planned_capacity, together},
    range::check,
    scene::used_degree,
};
use crate::{
    Error, Result,
    gpu::{Arena, Claim, Device, Limits, Profile, ResidentLayout, Target},
    types::{Camera, LeftOut, Scene},
};

/// Plans that are kept: sizes and requests that alternate.
const PLANS: usize = 4;
/// Draws scenes on one device. A plan is recorded once for a size, number of cameras and request, then replayed; all of them
/// share an arena.
pub struct Renderer {
    arena: Arena,
    scene: Option<DeviceScene>,
    /// Where [`Renderer::load`] brings scenes to.
    uploaded: Option<SceneMemory>,
    /// Last used last.
    plans: Vec<Planned>,
    /// Room for intersections of a camera in new plans; grows with what was drawn.
    capacity: usize,
    /// Intersections in what was drawn last.
    intersections: usize,
    /// More at once did not fit.
    cameras_at_once: usize,
    /// Most pictures of one submission of [`Renderer::render_each`].
    pub(super) together: usize,
}

impl Renderer {
    /// A renderer without a scene.
    pub fn new(device: &Device) -> Self {
        Self::with_capacity(device, 0)
    }

    /// As [`Renderer::new`], with room for so many intersections of Gaussians with tiles in a picture before it
    /// has to grow; 0 leaves that to the scene's size.
    pub fn with_capacity(device: &Device, capacity: usize) -> Self {
        Self { capacity, ..Self::in_arena(&Arena::new(device)) }
    }

    /// A renderer without a scene in an arena that others use, too. Where somebody else is using it when a picture is asked for,
    /// the renderer moves to one of its own.
    pub fn in_arena(arena: &Arena) -> Self {
        Self {
            arena: arena.clone(),
            scene: None,
            uploaded: None,
            plans: Vec::new(),
            capacity: 0,
            intersections: 0,
            cameras_at_once: usize::MAX,
            together: together(arena.device().limits()),
        }
    }

    /// The device that it draws on.
    pub fn device(&self) -> &Device {
        self.arena.device()
    }

    /// Lets [`Renderer::render_each`] draw up to `most` pictures in a submission, where they are small.
    pub fn together(mut self, most: usize) -> Self {
        self.together = most.max(1);
        self
    }

    /// Draws `scene` with each camera, in their order.
    ///
    /// # Errors
    /// [`Error::Argument`] where the scene, a camera or the request cannot be drawn; [`Error::Memory`] where one
    /// picture needs more than the device has.
    pub fn render(&mut self, scene: &Scene, cameras: &[Camera], request: &RenderRequest) -> Result<Vec<Frame>> {
        self.load(scene)?;
        self.render_loaded(cameras, request)
    }

    /// Brings a scene to the device for [`Renderer::render_loaded`].
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn load(&mut self, scene: &Scene) -> Result<()> {
        scene.validate()?;
        self.scene = None;
        let degree = used_degree(scene);
        let fits = |memory: &SceneMemory| {
            (memory.tensors().len, memory.tensors().sh_degree) == (scene.len(), degree) && memory.is_free()
        };
        let memory = match self.uploaded.take().filter(fits) {
            Some(memory) => memory,
            None => {
                // Before another is allocated: they hold the scene that was.
                self.forget_plans();
                self.allocate(scene.len(), degree)?
            }
        };
        let scene = self.uploaded.insert(memory).write(scene)?;
        self.show(&scene)
    }

    /// Draws a scene that is on the device already in [`Renderer::render_loaded`]: one of a reconstruction in the arena that it was
    /// made in.
    ///
    /// # Errors
    /// [`Error::Argument`] where it is on another device; [`Error::DeviceLost`].
    pub fn show(&mut self, scene: &DeviceScene) -> Result<()> {
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
        if self.plans.first().is_some_and(|plan| plan.scene != *scene.tensors()) {
            self.forget_plans();
        }
        self.plans.iter_mut().for_each(|plan| plan.run.replace_resident(scene.resident().clone()));
        self.scene = Some(scene.clone());
        Ok(())
    }

    /// The scene that was loaded last, for those who record plans of their own.
    pub fn scene(&self) -> Option<&DeviceScene> {
        self.scene.as_ref()
    }

    /// Draws the scene that was loaded last.
    ///
    /// # Errors
    /// As [`Renderer::render`], and [`Error::Argument`] where no scene was loaded.
    pub fn render_loaded(&mut self, cameras: &[Camera], request: &RenderRequest) -> Result<Vec<Frame>> {
        check(cameras, request)?;
        let _claim = self.claim();
        let mut sizes: Vec<(u32, u32)> = cameras.iter().map(|c| (c.intrinsics.width, c.intrinsics.height)).collect();
        sizes.sort_unstable();
        sizes.dedup();
        let mut frames: Vec<Option<Frame>> = cameras.iter().map(|_| None).collect();
        for size in sizes {
            let alike =
                (0..cameras.len()).filter(|&i| (cameras[i].intrinsics.width, cameras[i].intrinsics.height) == size);
            let indices: Vec<usize> = alike.collect();
            let rows: Vec<CameraRows> = indices.iter().map(|&i| camera_rows(&cameras[i])).collect();
            for (index, frame) in indices.into_iter().zip(self.render_alike(&rows, size, request)?) {
                frames[index] = Some(frame);
            }
        }
        Ok(frames.into_iter().flatten().collect())
    }

    /// Intersections of Gaussians with tiles in what was drawn last.
    pub fn intersections(&self) -> usize {
        self.intersections
    }

    /// Effects that pictures of the scene that was loaded last do without, and why.
    pub fn left_out(&self, request: &RenderRequest) -> Vec<LeftOut> {
        let degrees = self.scene.as_ref().map_or((0, 0), |scene| (scene.stored_degree(), scene.tensors().sh_degree));
        request.left_out(degrees.0, degrees.1)
    }

    /// Draws the scene that was loaded last with one camera into an app's image or buffer, without the host: when this
    /// returns the picture is drawn, and its copy to `target` was submitted. The next drawing of the same size waits for
    /// that copy. Of `request`, background and antialiasing count; drawn are colour and alpha.
    ///
    /// # Errors
    /// As [`Renderer::render_loaded`], and those of [`Run::present`](crate::gpu::Run::present).
    pub fn render_to(
        &mut self,
        camera: &Camera,
        request: &RenderRequest,
        layout: PixelLayout,
        target: &Target,
    ) -> Result<()> {
        let request = RenderRequest {
            alpha: true,
            background: request.background,
            antialiased: request.antialiased,
            near: request.near,
            layout: Some(layout),
            ..RenderRequest::default()
        };
        check(std::slice::from_ref(camera), &request)?;
        let _claim = self.claim();
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        self.render_together(&[camera_rows(camera)], (width, height), &request, 0)?;
        let plan = self.plan(FrameShape { cameras: 1, width, height }, &request, 0)?;
        plan.run.present(plan.outputs.pixels, target)
    }

    /// Device time of drawing the scene that was loaded last with one camera, by kernel.
    ///
    /// # Errors
    /// As [`Renderer::render_loaded`].
    pub fn profile(&mut self, camera: &Camera, request: &RenderRequest) -> Result<Profile> {
        check(std::slice::from_ref(camera), request)?;
        let _claim = self.claim();
        // Afterwards there is a plan with room for every intersection.
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        self.render_alike(&[camera_rows(camera)], size, request)?;
        let shape = FrameShape { cameras: 1, width: camera.intrinsics.width, height: camera.intrinsics.height };
        let plan = self.plan(shape, request, 0)?;
        plan.run.write(plan.cameras, &[camera_rows(camera)])?;
        plan.run.profile()
    }

    /// Draws cameras of one size, as many at once as there is memory for.
    pub(super) fn render_alike(
        &mut self,
        cameras: &[CameraRows],
        size: (u32, u32),
        request: &RenderRequest,
    ) -> Result<Vec<Frame>> {
        let bytes_each = [12 * self.gaussians(), 4 * request.channels() * size.0 as usize * size.1 as usize];
        let bindable = self.limits().max_binding_bytes as usize / bytes_each[0].max(bytes_each[1]);
        let mut frames = Vec::with_capacity(cameras.len());
        // Plans of other sizes and requests, which take memory, too.
        let mut others = !self.plans.is_empty();
        while frames.len() < cameras.len() {
            let left = &cameras[frames.len()..];
            let together = &left[..left.len().min(self.cameras_at_once).min(bindable.max(1))];
            match self.render_together(together, size, request, 0) {
                Ok(drawn) => frames.extend(drawn),
                Err(Error::Memory { .. }) if together.len() > 1 => {
                    self.cameras_at_once = together.len() / 2;
                    self.capacity = 0;
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

    pub(super) fn render_together(
        &mut self,
        cameras: &[CameraRows],
        (width, height): (u32, u32),
        request: &RenderRequest,
        turn: usize,
    ) -> Result<Vec<Frame>> {
        let shape = FrameShape { cameras: cameras.len(), width, height };
        let most = self.limits().max_binding_bytes / 4;
        loop {
            let plan = self.plan(shape, request, turn)?;
            plan.run.write(plan.cameras, cameras)?;
            plan.run.execute()?;
            let needed = plan.needed()?;
            let frames = match (needed <= plan.capacity, request.layout) {
                (true, Some(_)) => Some(Vec::new()), // Nobody reads them on the host.
                (true, None) => Some(plan.read()?),
                (false, _) => None,
            };
            self.intersections = needed;
            if let Some(frames) = frames {
                return Ok(frames);
            }
            if needed as u64 > most {
                let what = "a list of the intersections of Gaussians with tiles".into();
                return Err(Error::Memory { what, needed: 4 * needed as u64, available: 4 * most });
            }
            // A camera that moves a little should not outgrow it at once.
            self.capacity = self.capacity.max((needed + needed / 4).div_ceil(cameras.len()));
            self.plans.pop();
        }
    }

    /// The plan for `shape` and `request`, of those alike the one of this turn. It is last among the plans afterwards.
    pub(super) fn plan(&mut self, shape: FrameShape, request: &RenderRequest, turn: usize) -> Result<&mut Planned> {
        let Some(scene) = &self.scene else {
            return Err(Error::argument("scene to render", "none", "one that was loaded before"));
        };
        let key = Key { shape, request: request.with_near(scene.near()), turn };
        let known = self.plans.iter().position(|planned| planned.key == key);
        let planned = match known {
            Some(index) => self.plans.remove(index),
            None => {
                if self.plans.len() == PLANS {
                    self.plans.remove(0);
                }
                if self.capacity == 0 {
                    self.capacity = first_capacity(scene.len());
                }
                let capacity = planned_capacity(self.limits(), self.capacity, shape);
                Planned::new(&self.arena, scene, key, capacity)?
            }
        };
        self.plans.push(planned);
        Ok(self.plans.last_mut().expect("just pushed"))
    }

    fn forget_plans(&mut self) {
        self.plans.clear();
        self.cameras_at_once = usize::MAX;
    }

    /// Memory for a scene; where there is too little, that of the plans is given back for it.
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

    /// Makes room: nothing stays of what was recorded and of its memory.
    pub(super) fn start_over(&mut self) -> Result<()> {
        self.plans.clear();
        self.arena.release()
    }

    /// The right to draw: in an arena of its own where somebody else uses the shared one now.
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

    /// Gaussians of the scene.
    pub(super) fn gaussians(&self) -> usize {
        self.scene.as_ref().map_or(0, DeviceScene::len)
    }

    /// Waits for everything that is under way.
    pub(super) fn settle(&mut self) -> Result<()> {
        self.plans.iter_mut().try_for_each(|plan| plan.run.finish())
    }
}
