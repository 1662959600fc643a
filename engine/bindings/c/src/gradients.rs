//! Gradients of pictures with respect to Gaussians and cameras.

use super::{
    camera::zs_camera,
    image::zs_pixel_format,
    pointers::{array, array_mut, borrow, read_array, read_given, read_versioned},
    renderer::{zs_render_buffers, zs_render_options, zs_renderer},
    scene::zs_scene,
    status::{Failure, guard, zs_status},
};
use zipsplat::{
    stages::render::{Differentiator, HostGradients, RenderOutput, Wanted},
    types::Camera,
};

/// Output buffers of gradients; NULL skips one. Values are overwritten, not accumulated.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_gradients {
    /// sizeof(zs_gradients).
    pub struct_size: u32,
    /// Must be 0.
    pub reserved: u32,
    /// N x 3.
    pub means: *mut f32,
    /// N x 3.
    pub scales: *mut f32,
    /// N x 4, of unnormalized rotations.
    pub quats: *mut f32,
    /// N.
    pub opacities: *mut f32,
    /// N x K x 3.
    pub sh_coeffs: *mut f32,
    /// count x 10, of the cameras: w x, y, z and v x, y, z, then fx, fy, cx, cy. The
    /// camera-to-world pose moves as pose o (exp(w^), v): R' = R exp(w^) and t' = t + R v.
    pub cameras: *mut f32,
    /// count x N x 2, of the projected centers in pixels, at constant projected covariances.
    pub means2d: *mut f32,
}

versioned!(zs_gradients);

/// Computes the gradients of a weighted sum over all pixels of `count` cameras' pictures.
///
/// `grad_outputs` points to the weights of color, alpha and depth, read only; NULL is 0. The format must be
/// ZS_PIXEL_RGB_F32. Zero-valued coefficients also get gradients. `scene` need not be the
/// renderer's, which keeps a second scene on the device. `gradients` is written only on success.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_render_backward(
    renderer: *const zs_renderer,
    scene: *const zs_scene,
    cameras: *const zs_camera,
    grad_outputs: *const zs_render_buffers,
    count: usize,
    options: *const zs_render_options,
    gradients: *const zs_gradients,
) -> zs_status {
    guard(|| {
        // SAFETY: objects or NULL; structures or NULL; arrays of the caller's.
        let (renderer, scene, cameras, weights, options, to) = unsafe {
            let (cameras, weights) =
                (read_array(cameras, count, "cameras")?, read_array(grad_outputs, count, "grad_outputs")?);
            let (renderer, scene) = (borrow(renderer, "renderer")?, borrow(scene, "scene")?);
            (renderer, scene, cameras, weights, read_versioned(options)?, read_given(gradients)?)
        };
        if options.checked()? != zs_pixel_format::ZS_PIXEL_RGB_F32 {
            let expected = "ZS_PIXEL_RGB_F32, the format of their weights";
            return Err(Failure::argument("pixel format of gradients", options.format, expected));
        }
        if to.reserved != 0 {
            return Err(Failure::argument("zs_gradients, reserved", to.reserved, "0"));
        }
        let cameras: Vec<Camera> = cameras.iter().map(zs_camera::camera).collect::<Result<_, _>>()?;
        let request = options.request(zs_pixel_format::ZS_PIXEL_RGB_F32, &weights)?.differentiable();
        let mut frames = Vec::with_capacity(count);
        for (i, (camera, picture)) in cameras.iter().zip(&weights).enumerate() {
            camera.validate(&format!("camera {i}"))?;
            // SAFETY: the caller's memory, as large as the camera's picture.
            frames.push(unsafe { picture.weights(camera, i) }?);
        }
        let any = [to.means, to.scales, to.quats, to.opacities, to.sh_coeffs].iter().any(|field| !field.is_null());
        let wanted = Wanted { scene: any, cameras: !to.cameras.is_null(), means2d: !to.means2d.is_null() };
        if request.channels() == 0 {
            return Err(Failure::argument("grad_outputs", "NULL throughout", "those of color, alpha or depth"));
        }
        let mut differentiator = renderer.differentiator();
        let differentiator = differentiator.get_or_insert_with(|| Differentiator::new(renderer.lock().device()));
        let found = differentiator.differentiate(&scene.scene, &cameras, &request, &frames, wanted)?;
        // SAFETY: the caller's memory, as long as the structure says.
        unsafe { to.write(&found) }
    })
}

impl zs_render_buffers {
    /// # Safety
    /// Pointers that are not NULL have values for every pixel.
    unsafe fn weights(&self, camera: &Camera, i: usize) -> Result<RenderOutput, Failure> {
        for (field, found) in [("reserved", i64::from(self.reserved)), ("stride", self.stride)] {
            if found != 0 {
                return Err(Failure::argument(format!("grad_outputs {i}, {field}"), found, "0"));
            }
        }
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = width as usize * height as usize;
        let plane = |from: *const f32, values: usize, name: &str| -> Result<Option<Vec<f32>>, Failure> {
            // SAFETY: the caller's promise.
            (!from.is_null()).then(|| Ok(unsafe { array(from, values, name) }?.to_vec())).transpose()
        };
        Ok(RenderOutput {
            width,
            height,
            rgb: plane(self.pixels.cast(), 3 * pixels, "grad_outputs of color")?,
            alpha: plane(self.alpha, pixels, "grad_outputs of alpha")?,
            depth: plane(self.depth, pixels, "grad_outputs of depth")?,
            normals: None,
            token_colors: None,
        })
    }
}

impl zs_gradients {
    /// # Safety
    /// Pointers that are not NULL have capacity for all gradients of their kind.
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
