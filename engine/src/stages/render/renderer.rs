//! Draws a scene again and again: keeps it on the device, and keeps plans.

use super::{
    CameraRows, Frame, FrameShape, PixelLayout, RenderOutputs, RenderRequest, SceneTensors, camera_rows,
    range::{check, drawable},
    record,
};
use crate::{
    Error, Result,
    gpu::{Device, Profile, Recorder, Resident, ResidentLayout, Run, Target, Tensor},
    types::{Camera, LeftOut, Scene},
};
use std::sync::Arc;

/// Plans that are kept: sizes and requests that alternate.
const PLANS: usize = 4;
/// Pictures of one submission on a GPU, which small ones do not fill. A CPU is full with one, whose lists its caches hold.
const GPU_TOGETHER: usize = 8;
/// Draws scenes on one device. A plan is recorded once for a size, number of cameras and request, then replayed.
pub struct Renderer {
    device: Device,
    scene: Option<Loaded>,
    /// Last used last.
    plans: Vec<Planned>,
    /// Room for intersections of a camera in new plans; grows with what was drawn.
    capacity: usize,
    /// More at once did not fit.
    cameras_at_once: usize,
    /// Most pictures of one submission of [`Renderer::render_each`].
    pub(super) together: usize,
}

struct Loaded {
    memory: Arc<Resident>,
    tensors: SceneTensors,
    /// Degree that the scene has, of which the tensors hold what is used.
    stored_degree: u32,
}

/// What a plan is for.
#[derive(Clone, Copy, PartialEq)]
struct Key {
    shape: FrameShape,
    request: RenderRequest,
    /// Which of the plans that are alike, for pictures in flight.
    turn: usize,
}

pub(super) struct Planned {
    key: Key,
    capacity: usize,
    pub run: Run,
    pub cameras: Tensor,
    outputs: RenderOutputs,
}

impl Renderer {
    /// A renderer without a scene.
    pub fn new(device: &Device) -> Self {
        Self::with_capacity(device, 0)
    }

    /// As [`Renderer::new`], with room for so many intersections of Gaussians with tiles in a picture before it
    /// has to grow; 0 leaves that to the scene's size.
    pub fn with_capacity(device: &Device, capacity: usize) -> Self {
        Self {
            device: device.clone(),
            scene: None,
            plans: Vec::new(),
            capacity,
            cameras_at_once: usize::MAX,
            together: if device.limits().cpu { 1 } else { GPU_TOGETHER },
        }
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
        let degree = used_degree(scene);
        let same = |s: &SceneTensors| (s.len, s.sh_degree) == (scene.len(), degree);
        let loaded = match self.scene.take().filter(|loaded| same(&loaded.tensors)) {
            Some(loaded) => loaded,
            None => {
                // Before another is allocated: they hold the scene that was.
                self.plans.clear();
                self.cameras_at_once = usize::MAX;
                Loaded::allocate(&self.device, scene.len(), degree)?
            }
        };
        let Loaded { memory, tensors, .. } = self.scene.insert(Loaded { stored_degree: scene.sh_degree, ..loaded });
        memory.write(tensors.means, &scene.means)?;
        memory.write(tensors.scales, &scene.scales)?;
        memory.write(tensors.quats, &drawable(&scene.quats))?;
        memory.write(tensors.opacities, &scene.opacities)?;
        if degree == scene.sh_degree {
            return memory.write(tensors.sh_coeffs, &scene.sh_coeffs);
        }
        let used = coeffs_of(degree);
        let coeffs = scene.sh_coeffs.chunks_exact(scene.sh_coeffs_per_gaussian()).flat_map(|all| &all[..used]);
        memory.write(tensors.sh_coeffs, &coeffs.copied().collect::<Vec<_>>())
    }

    /// Draws the scene that was loaded last.
    ///
    /// # Errors
    /// As [`Renderer::render`], and [`Error::Argument`] where no scene was loaded.
    pub fn render_loaded(&mut self, cameras: &[Camera], request: &RenderRequest) -> Result<Vec<Frame>> {
        check(cameras, request)?;
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
    ///
    /// # Errors
    /// Where the transfer fails.
    pub fn intersections(&self) -> Result<usize> {
        self.plans.last().map_or(Ok(0), Planned::needed)
    }

    /// Effects that pictures of the scene that was loaded last do without, and why.
    pub fn left_out(&self, request: &RenderRequest) -> Vec<LeftOut> {
        let degrees = self.scene.as_ref().map_or((0, 0), |scene| (scene.stored_degree, scene.tensors.sh_degree));
        request.left_out(degrees.0, degrees.1)
    }

    /// Draws the scene that was loaded last with one camera into an app's image or buffer, without the host: when this
    /// returns the picture is drawn, and its copy to `target` was submitted. The next drawing of the same size waits for
    /// that copy. Of `request`, background and antialiasing count; drawn are colour and alpha.
    ///
    /// # Errors
    /// As [`Renderer::render_loaded`], and those of [`Run::present`].
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
            layout: Some(layout),
            ..RenderRequest::default()
        };
        check(std::slice::from_ref(camera), &request)?;
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
        // Afterwards there is a plan with room for every intersection.
        self.render_loaded(std::slice::from_ref(camera), request)?;
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
        let bindable = self.device.limits().max_binding_bytes as usize / bytes_each[0].max(bytes_each[1]);
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
                    self.forget_plans();
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
        let most = self.device.limits().max_binding_bytes / 4;
        loop {
            let plan = self.plan(shape, request, turn)?;
            plan.run.write(plan.cameras, cameras)?;
            plan.run.execute()?;
            let needed = plan.needed()?;
            if needed <= plan.capacity && request.layout.is_some() {
                return Ok(Vec::new()); // Nobody reads them on the host.
            }
            if let Some(frames) = plan.frames()? {
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
        let key = Key { shape, request: *request, turn };
        let known = self.plans.iter().position(|planned| planned.key == key);
        let planned = match known {
            Some(index) => self.plans.remove(index),
            None => {
                if self.plans.len() == PLANS {
                    self.plans.remove(0);
                }
                if self.capacity == 0 {
                    self.capacity = (4 * scene.tensors.len).max(1 << 16);
                }
                let most = self.device.limits().max_binding_bytes as usize / 4;
                let capacity = self.capacity.saturating_mul(shape.cameras).min(most);
                scene.plan(&self.device, key, capacity)?
            }
        };
        self.plans.push(planned);
        Ok(self.plans.last_mut().expect("just pushed"))
    }

    pub(super) fn forget_plans(&mut self) {
        self.plans.clear();
    }

    /// Gaussians of the scene.
    pub(super) fn gaussians(&self) -> usize {
        self.scene.as_ref().map_or(0, |scene| scene.tensors.len)
    }

    /// Waits for everything that is under way.
    pub(super) fn settle(&mut self) -> Result<()> {
        self.plans.iter_mut().try_for_each(|plan| plan.run.finish())
    }
}

impl Planned {
    /// Intersections that the last run found; more than can be counted as 2^32.
    fn needed(&self) -> Result<usize> {
        let status: Vec<u32> = self.run.read(self.outputs.status)?;
        Ok(RenderOutputs::needed(&status).unwrap_or(1 << 32))
    }

    /// The pictures of the last run, unless they needed more room.
    pub(super) fn frames(&self) -> Result<Option<Vec<Frame>>> {
        if self.needed()? > self.capacity {
            return Ok(None);
        }
        let values: Vec<f32> = self.run.read(self.outputs.frames)?;
        let FrameShape { cameras, width, height } = self.key.shape;
        let frame = |values| Frame::from_channels(width, height, values, &self.key.request);
        if cameras == 1 {
            return Ok(Some(vec![frame(values)]));
        }
        Ok(Some(values.chunks_exact(values.len() / cameras).map(|values| frame(values.to_vec())).collect()))
    }
}

impl Loaded {
    fn allocate(device: &Device, len: usize, sh_degree: u32) -> Result<Self> {
        let mut layout = ResidentLayout::new(device.limits());
        let tensors = SceneTensors {
            means: layout.add::<[f32; 3]>(len),
            scales: layout.add::<[f32; 3]>(len),
            quats: layout.add::<[f32; 4]>(len),
            opacities: layout.add::<f32>(len),
            sh_coeffs: layout.add::<[f32; 3]>(len * coeffs_of(sh_degree)),
            len,
            sh_degree,
        };
        Ok(Self { memory: Arc::new(Resident::new(device, &layout)?), tensors, stored_degree: sh_degree })
    }

    fn plan(&self, device: &Device, key: Key, capacity: usize) -> Result<Planned> {
        let mut rec = Recorder::new(device.limits());
        let cameras = rec.input::<CameraRows>("cameras", key.shape.cameras);
        let outputs = record(&mut rec, &self.tensors, cameras, key.shape, &key.request, capacity);
        let run = Run::with_resident(device, rec.finish()?, Some(self.memory.clone()))?.in_flight()?;
        Ok(Planned { key, capacity, run, cameras, outputs })
    }
}

/// Coefficients up to a degree.
fn coeffs_of(degree: u32) -> usize {
    (degree as usize + 1).pow(2)
}

/// Degree of the highest band that is not all zero: what is above it is neither stored nor evaluated.
fn used_degree(scene: &Scene) -> u32 {
    let stride = scene.sh_coeffs_per_gaussian();
    let zero = |degree: u32| {
        let band = (degree as usize).pow(2)..(degree as usize + 1).pow(2);
        scene.sh_coeffs.chunks_exact(stride).all(|coeffs| coeffs[band.clone()].iter().all(|rgb| *rgb == [0.0; 3]))
    };
    (1..=scene.sh_degree).rev().find(|&degree| !zero(degree)).unwrap_or(0)
}
