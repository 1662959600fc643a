//! Gradients of pictures with respect to Gaussians and cameras.

use super::{
    camera::{read_cameras, zs_camera},
    pointers::{array, array_mut, borrow, read_array, read_given, read_versioned},
    renderer::{zs_render_options, zs_renderer},
    scene::zs_scene,
    status::{Failure, guard, zs_status},
};
use zipsplat::{
    Camera, RenderOutput,
    stages::render::{Differentiator, HostGradients, Wanted},
};

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_grad_outputs {
    pub struct_size: u32,
    pub reserved: u32,
    pub color: *const f32,
    pub alpha: *const f32,
    pub depth: *const f32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_gradients {
    pub struct_size: u32,
    pub reserved: u32,
    pub means: *mut f32,
    pub scales: *mut f32,
    pub quats: *mut f32,
    pub opacities: *mut f32,
    pub sh_coeffs: *mut f32,
    pub cameras: *mut f32,
    pub means2d: *mut f32,
}

versioned!(zs_grad_outputs { reserved }, zs_gradients { reserved });

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_render_backward(
    renderer: *const zs_renderer,
    scene: *const zs_scene,
    cameras: *const zs_camera,
    grad_outputs: *const zs_grad_outputs,
    count: usize,
    options: *const zs_render_options,
    gradients: *const zs_gradients,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, scene, cameras, grads, options, to) = unsafe {
            let cameras = read_cameras(cameras, count)?;
            let grads = read_array(grad_outputs, count, "grad_outputs")?;
            let renderer = borrow(renderer, "renderer")?;
            (renderer, scene.as_ref(), cameras, grads, read_versioned(options)?, read_given(gradients)?)
        };
        let scene = match scene {
            Some(scene) => Some(scene.scene.clone()),
            None => renderer.scene().clone(),
        };
        let scene =
            scene.ok_or_else(|| Failure::argument("scene", "NULL", "one, as the renderer has none in memory"))?;
        let any = |field: fn(&zs_grad_outputs) -> *const f32| grads.iter().any(|grads| !field(grads).is_null());
        options.checked()?;
        let options = options.outputs(any(|g| g.color), any(|g| g.alpha), any(|g| g.depth))?.differentiable();
        if options.channels() == 0 {
            return Err(Failure::argument("grad_outputs", "NULL throughout", "those of color, alpha or depth"));
        }
        let mut outputs = Vec::with_capacity(count);
        for (i, (camera, grads)) in cameras.iter().zip(&grads).enumerate() {
            camera.validate(&format!("camera {i}"))?;
            // SAFETY: the caller's memory, as large as the camera's picture.
            outputs.push(unsafe { grads.read(camera) }?);
        }
        let any = [to.means, to.scales, to.quats, to.opacities, to.sh_coeffs].iter().any(|field| !field.is_null());
        let wanted = Wanted { scene: any, cameras: !to.cameras.is_null(), means2d: !to.means2d.is_null() };
        let mut differentiator = renderer.differentiator();
        let differentiator = differentiator.get_or_insert_with(|| Differentiator::new(renderer.lock().device()));
        let found = differentiator.differentiate(&scene, &cameras, &options, &outputs, wanted)?;
        // SAFETY: the caller's memory, as long as the structure says.
        unsafe { to.write(&found) }
    })
}

impl zs_grad_outputs {
    /// # Safety
    /// Non-NULL pointers have values for every pixel.
    unsafe fn read(&self, camera: &Camera) -> Result<RenderOutput, Failure> {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = width as usize * height as usize;
        let plane = |from: *const f32, values: usize, name: &str| -> Result<Option<Vec<f32>>, Failure> {
            // SAFETY: the caller's promise.
            (!from.is_null()).then(|| Ok(unsafe { array(from, values, name) }?.to_vec())).transpose()
        };
        Ok(RenderOutput {
            width,
            height,
            rgb: plane(self.color, 3 * pixels, "grad_outputs of color")?,
            alpha: plane(self.alpha, pixels, "grad_outputs of alpha")?,
            depth: plane(self.depth, pixels, "grad_outputs of depth")?,
            normals: None,
            token_colors: None,
        })
    }
}

impl zs_gradients {
    /// # Safety
    /// Non-NULL pointers have capacity for all gradients of their kind.
    unsafe fn write(&self, found: &HostGradients) -> Result<(), Failure> {
        let (scene, cameras) = (&found.scene, found.cameras.as_flattened());
        let fields = [
            ("means", self.means, scene.means.as_flattened()),
            ("scales", self.scales, scene.scales.as_flattened()),
            ("quats", self.quats, scene.quats.as_flattened()),
            ("opacities", self.opacities, &scene.opacities),
            ("sh_coeffs", self.sh_coeffs, scene.sh_coeffs.as_flattened()),
            ("cameras", self.cameras, cameras),
            ("means2d", self.means2d, found.means2d.as_flattened()),
        ];
        for (name, to, from) in fields.into_iter().filter(|(_, to, _)| !to.is_null()) {
            // SAFETY: the caller's promise.
            unsafe { array_mut(to, from.len(), name) }?.copy_from_slice(from);
        }
        Ok(())
    }
}
