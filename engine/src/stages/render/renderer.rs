//! Draws a scene again and again: keeps it on the device, and keeps plans.

use super::{
    CameraRows, Frame, FrameShape, PixelLayout, RenderOutputs, RenderRequest, SceneTensors, camera_rows, record,
};
use crate::{
    Error, Result,
    gpu::{Device, Profile, Recorder, Resident, ResidentLayout, Run, Target, Tensor},
    types::{Camera, Scene},
};
use std::sync::Arc;

/// Plans that are kept: sizes and requests that alternate.
const PLANS: usize = 4;
/// Longest side of a picture: its pixels count in 32 bits, and the kernels' margins for rounding hold.
pub const MAX_SIDE: u32 = 1 << 15;

/// Draws scenes on one device. A plan is recorded once for a size, number of cameras and request, then replayed.
pub struct Renderer {
    device: Device,
    scene: Option<Loaded>,
    /// Last used last.
    plans: Vec<Planned>,
    /// Room for intersections in new plans; grows with what was drawn.
    capacity: usize,
    /// More at once did not fit.
    cameras_at_once: usize,
}

struct Loaded {
    memory: Arc<Resident>,
    tensors: SceneTensors,
}

struct Planned {
    shape: FrameShape,
    request: RenderRequest,
    capacity: usize,
    run: Run,
    cameras: Tensor,
    outputs: RenderOutputs,
}

impl Renderer {
    /// A renderer without a scene.
    pub fn new(device: &Device) -> Self {
        Self::with_capacity(device, 0)
    }

    /// As [`Renderer::new`], with room for so many intersections of Gaussians with tiles before it has to grow; 0
    /// leaves that to the scene's size.
    pub fn with_capacity(device: &Device, capacity: usize) -> Self {
        Self { device: device.clone(), scene: None, plans: Vec::new(), capacity, cameras_at_once: usize::MAX }
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
        let used = used_degree(scene);
        let same = |s: &SceneTensors| (s.len, s.sh_degree, s.sh_degree_used) == (scene.len(), scene.sh_degree, used);
        let loaded = match self.scene.take() {
            Some(loaded) if same(&loaded.tensors) => loaded,
            _ => {
                self.plans.clear();
                self.cameras_at_once = usize::MAX;
                Loaded::allocate(&self.device, scene, used)?
            }
        };
        let Loaded { memory, tensors } = self.scene.insert(loaded);
        memory.write(tensors.means, &scene.means)?;
        memory.write(tensors.scales, &scene.scales)?;
        memory.write(tensors.quats, &scene.quats)?;
        memory.write(tensors.opacities, &scene.opacities)?;
        memory.write(tensors.sh_coeffs, &scene.sh_coeffs)
    }

    /// Draws the scene that was loaded last.
    ///
    /// # Errors
    /// As [`Renderer::render`], and [`Error::Argument`] where no scene was loaded.
    pub fn render_loaded(&mut self, cameras: &[Camera], request: &RenderRequest) -> Result<Vec<Frame>> {
        check(cameras, request)?;
        let mut sizes: Vec<(u32, u32)> = Vec::new();
        for camera in cameras {
            let size = (camera.intrinsics.width, camera.intrinsics.height);
            if !sizes.contains(&size) {
                sizes.push(size);
            }
        }
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
        let request = RenderRequest { rgb: true, alpha: true, depth: None, layout: Some(layout), ..*request };
        check(std::slice::from_ref(camera), &request)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        self.render_together(&[camera_rows(camera)], (width, height), &request)?;
        let plan = self.plan(FrameShape { cameras: 1, width, height }, &request)?;
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
        let plan = self.plan(shape, request)?;
        plan.run.write(plan.cameras, &[camera_rows(camera)])?;
        plan.run.profile()
    }

    /// Draws cameras of one size, as many at once as there is memory for.
    fn render_alike(
        &mut self,
        cameras: &[CameraRows],
        size: (u32, u32),
        request: &RenderRequest,
    ) -> Result<Vec<Frame>> {
        let bytes_each = [
            12 * self.scene.as_ref().map_or(0, |scene| scene.tensors.len),
            4 * request.channels() * size.0 as usize * size.1 as usize,
        ];
        let bindable = self.device.limits().max_binding_bytes as usize / bytes_each[0].max(bytes_each[1]);
        let mut frames = Vec::with_capacity(cameras.len());
        while frames.len() < cameras.len() {
            let left = &cameras[frames.len()..];
            let together = &left[..left.len().min(self.cameras_at_once).min(bindable.max(1))];
            match self.render_together(together, size, request) {
                Ok(drawn) => frames.extend(drawn),
                Err(Error::Memory { .. }) if together.len() > 1 => {
                    self.cameras_at_once = together.len() / 2;
                    self.capacity = 0;
                }
                Err(error) => return Err(error),
            }
        }
        Ok(frames)
    }

    fn render_together(
        &mut self,
        cameras: &[CameraRows],
        (width, height): (u32, u32),
        request: &RenderRequest,
    ) -> Result<Vec<Frame>> {
        let shape = FrameShape { cameras: cameras.len(), width, height };
        let most = self.device.limits().max_binding_bytes / 4;
        loop {
            let plan = self.plan(shape, request)?;
            plan.run.write(plan.cameras, cameras)?;
            plan.run.execute()?;
            let status: Vec<u32> = plan.run.read(plan.outputs.status)?;
            let needed = RenderOutputs::needed(&status).unwrap_or(1 << 32);
            if needed <= plan.capacity && request.layout.is_some() {
                return Ok(Vec::new()); // Nobody reads them on the host.
            }
            if needed <= plan.capacity {
                let values: Vec<f32> = plan.run.read(plan.outputs.frames)?;
                let frame = |values| Frame::from_channels(width, height, values, request);
                return Ok(values.chunks_exact(values.len() / cameras.len()).map(frame).collect());
            }
            if needed as u64 > most {
                let what = "a list of the intersections of Gaussians with tiles".into();
                return Err(Error::Memory { what, needed: 4 * needed as u64, available: 4 * most });
            }
            // A camera that moves a little should not outgrow it at once.
            self.capacity = (needed + needed / 4).min(most as usize);
            self.plans.pop();
        }
    }

    /// The plan for `shape` and `request`, which is last among the plans afterwards.
    fn plan(&mut self, shape: FrameShape, request: &RenderRequest) -> Result<&mut Planned> {
        let Some(scene) = &self.scene else {
            return Err(Error::argument("scene to render", "none", "one that was loaded before"));
        };
        let known = self.plans.iter().position(|p| p.shape == shape && p.request == *request);
        let planned = match known {
            Some(index) => self.plans.remove(index),
            None => {
                if self.plans.len() == PLANS {
                    self.plans.remove(0);
                }
                if self.capacity == 0 {
                    let most = self.device.limits().max_binding_bytes as usize / 4;
                    self.capacity = (4 * scene.tensors.len * shape.cameras).clamp(1 << 16, most);
                }
                scene.plan(&self.device, shape, request, self.capacity)?
            }
        };
        self.plans.push(planned);
        Ok(self.plans.last_mut().expect("just pushed"))
    }
}

impl Loaded {
    fn allocate(device: &Device, scene: &Scene, sh_degree_used: u32) -> Result<Self> {
        let mut layout = ResidentLayout::new(device.limits());
        let len = scene.len();
        let tensors = SceneTensors {
            means: layout.add::<[f32; 3]>(len),
            scales: layout.add::<[f32; 3]>(len),
            quats: layout.add::<[f32; 4]>(len),
            opacities: layout.add::<f32>(len),
            sh_coeffs: layout.add::<[f32; 3]>(scene.sh_coeffs.len()),
            len,
            sh_degree: scene.sh_degree,
            sh_degree_used,
        };
        Ok(Self { memory: Arc::new(Resident::new(device, &layout)?), tensors })
    }

    fn plan(&self, device: &Device, shape: FrameShape, request: &RenderRequest, capacity: usize) -> Result<Planned> {
        let mut rec = Recorder::new(device.limits());
        let cameras = rec.input::<CameraRows>("cameras", shape.cameras);
        let outputs = record(&mut rec, &self.tensors, cameras, shape, request, capacity);
        let run = Run::with_resident(device, rec.finish()?, Some(self.memory.clone()))?;
        Ok(Planned { shape, request: *request, capacity, run, cameras, outputs })
    }
}

/// Holds that these pictures can be drawn.
fn check(cameras: &[Camera], request: &RenderRequest) -> Result<()> {
    if request.channels() == 0 {
        return Err(Error::argument("render request", "no output", "one of rgb, alpha and depth"));
    }
    for (i, camera) in cameras.iter().enumerate() {
        camera.validate(&format!("camera {i}"))?;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        if size.0.max(size.1) > MAX_SIDE {
            let found = format!("{} x {}", size.0, size.1);
            return Err(Error::argument(format!("size of camera {i}"), found, format!("sides up to {MAX_SIDE}")));
        }
    }
    Ok(())
}

/// Degree of the highest band that is not all zero: what is above it need not be evaluated.
fn used_degree(scene: &Scene) -> u32 {
    let stride = scene.sh_coeffs_per_gaussian();
    let zero = |degree: u32| {
        let band = (degree as usize).pow(2)..(degree as usize + 1).pow(2);
        scene.sh_coeffs.chunks_exact(stride).all(|coeffs| coeffs[band.clone()].iter().all(|rgb| *rgb == [0.0; 3]))
    };
    (1..=scene.sh_degree).rev().find(|&degree| !zero(degree)).unwrap_or(0)
}
