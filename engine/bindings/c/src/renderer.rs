//! Renderers: draw a scene from a device into host memory.

use super::{
    camera::{read_cameras, zs_camera},
    device::zs_device,
    image::{checked_stride, zs_pixel_format, zs_pixel_format_value},
    pointers::{array_mut, borrow, destroy, meaning, produce, read_array, read_given, read_versioned},
    reconstruction::zs_reconstruction,
    refine::{zs_antialiasing, zs_antialiasing_value},
    scene::{zs_gaussians, zs_scene},
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::c_void,
    sync::{Arc, Mutex, MutexGuard},
};
use zipsplat::{
    Depth, RenderOptions, RenderOutput, Renderer, Scene,
    features::FeatureRenderer,
    stages::render::{Differentiator, check_camera},
};

pub struct zs_renderer {
    pub(super) adopted: bool,
    renderer: Mutex<Renderer>,
    /// Host copy of the scene, unless it is a reconstruction's.
    scene: Mutex<Option<Arc<Scene>>>,
    differentiator: Mutex<Option<Differentiator>>,
    features: Mutex<Option<FeatureRenderer>>,
}

impl zs_renderer {
    /// Recovers a poisoned lock: a renderer validates its plans on every use.
    pub(super) fn lock(&self) -> MutexGuard<'_, Renderer> {
        self.renderer.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    pub(super) fn scene(&self) -> MutexGuard<'_, Option<Arc<Scene>>> {
        self.scene.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    pub(super) fn differentiator(&self) -> MutexGuard<'_, Option<Differentiator>> {
        emptied(&self.differentiator)
    }

    pub(super) fn features(&self) -> MutexGuard<'_, Option<FeatureRenderer>> {
        emptied(&self.features)
    }
}

/// Locks; empties after a panic.
fn emptied<T>(mutex: &Mutex<Option<T>>) -> MutexGuard<'_, Option<T>> {
    mutex.lock().unwrap_or_else(|poisoned| {
        let mut found = poisoned.into_inner();
        *found = None;
        found
    })
}

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_depth_mode {
    ZS_DEPTH_MODE_EXPECTED = 0,
    ZS_DEPTH_MODE_ACCUMULATED = 1,
}

pub(super) type zs_depth_mode_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_render_options {
    pub struct_size: u32,
    pub format: zs_pixel_format_value,
    pub depth: zs_depth_mode_value,
    pub antialiasing: zs_antialiasing_value,
    pub background: [f32; 3],
    pub near_plane: f32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_render_buffers {
    pub struct_size: u32,
    pub reserved: u32,
    pub stride: i64,
    pub pixels: *mut c_void,
    pub alpha: *mut f32,
    pub depth: *mut f32,
    pub normals: *mut f32,
}

versioned!(zs_render_options, zs_render_buffers { reserved });

const PIXELS_AT_ONCE: u64 = 1 << 24;

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_renderer_create(
    device: *const zs_device,
    scene: *const zs_scene,
    renderer: *mut *mut zs_renderer,
) -> zs_status {
    let create = || {
        // SAFETY: the caller's arguments.
        let (zs_device { gpu, adopted }, scene) = unsafe { (borrow(device, "device")?, scene.as_ref()) };
        let renderer = zs_renderer {
            adopted: *adopted,
            renderer: Mutex::new(Renderer::new(gpu)),
            scene: Mutex::default(),
            differentiator: Mutex::default(),
            features: Mutex::default(),
        };
        if let Some(scene) = scene {
            renderer.set(scene.scene.clone())?;
        }
        Ok(renderer)
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(renderer, create) }
}

impl zs_renderer {
    fn set(&self, scene: Arc<Scene>) -> Result<(), Failure> {
        let mut current = self.scene();
        self.lock().set_scene(&*scene)?;
        *current = Some(scene);
        Ok(())
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_renderer_set_scene(renderer: *mut zs_renderer, scene: *const zs_scene) -> zs_status {
    // SAFETY: the caller's arguments.
    guard(|| unsafe { borrow(renderer, "renderer")?.set(borrow(scene, "scene")?.scene.clone()) })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_renderer_set_reconstruction(
    renderer: *mut zs_renderer,
    reconstruction: *const zs_reconstruction,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, reconstruction) =
            unsafe { (borrow(renderer, "renderer")?, borrow(reconstruction, "reconstruction")?) };
        let mut current = renderer.scene();
        renderer.lock().set_scene(&reconstruction.made)?;
        *current = None;
        Ok(())
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_renderer_update_gaussians(
    renderer: *mut zs_renderer,
    gaussians: *const zs_gaussians,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, gaussians) = unsafe { (borrow(renderer, "renderer")?, read_given(gaussians)?) };
        let mut current = renderer.scene();
        let mut scene = current.take().and_then(|scene| Arc::try_unwrap(scene).ok()).unwrap_or_default();
        // SAFETY: the caller's arguments.
        unsafe { gaussians.copy_to(&mut scene) }?;
        renderer.lock().set_scene(&scene)?;
        *current = Some(Arc::new(scene));
        Ok(())
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_renderer_destroy(renderer: *mut zs_renderer) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(renderer) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_render(
    renderer: *const zs_renderer,
    cameras: *const zs_camera,
    pictures: *const zs_render_buffers,
    count: usize,
    options: *const zs_render_options,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, options, cameras, pictures) = unsafe {
            let (cameras, pictures) = (read_cameras(cameras, count)?, read_array(pictures, count, "pictures")?);
            (borrow(renderer, "renderer")?, read_versioned(options)?, cameras, pictures)
        };
        let format = options.checked()?;
        let mut strides = Vec::with_capacity(count);
        for (i, (camera, picture)) in cameras.iter().zip(&pictures).enumerate() {
            check_camera(i, camera)?;
            let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
            let row_bytes = width as usize * format.bytes();
            let name = format!("picture {i}, stride");
            strides.push(checked_stride(picture.stride, row_bytes, height, &name)?);
        }
        let request = options.engine(format, &pictures)?;
        let mut renderer = renderer.lock();
        let mut first = 0;
        while first < count {
            let pixels = |i: &usize| u64::from(cameras[*i].intrinsics.width) * u64::from(cameras[*i].intrinsics.height);
            let mut pixels_left = PIXELS_AT_ONCE;
            let more = (first + 1..count).take_while(|i| {
                pixels_left = pixels_left.saturating_sub(pixels(i));
                pixels_left > 0
            });
            let end = first + 1 + more.count();
            let frames = renderer.render(&cameras[first..end], &request)?;
            for (i, frame) in (first..end).zip(&frames) {
                // SAFETY: the caller's memory, as large as the camera's picture.
                unsafe { pictures[i].write(frame, format, strides[i])? };
            }
            first = end;
        }
        Ok(())
    })
}

impl zs_render_options {
    pub(super) fn checked(&self) -> Result<zs_pixel_format, Failure> {
        if !self.near_plane.is_finite() || self.near_plane < 0.0 {
            return Err(Failure::argument("near_plane", self.near_plane, "0 or a positive distance"));
        }
        if !self.background.iter().all(|value| value.is_finite()) {
            return Err(Failure::argument("background", format!("{:?}", self.background), "finite numbers"));
        }
        Ok(zs_pixel_format::of(self.format)?)
    }

    fn engine(&self, format: zs_pixel_format, pictures: &[zs_render_buffers]) -> Result<RenderOptions, Failure> {
        let rgb = pictures.iter().any(|picture| !picture.pixels.is_null());
        let alpha = pictures.iter().any(|picture| !picture.alpha.is_null()) || rgb && format.has_alpha();
        let depth = pictures.iter().any(|picture| !picture.depth.is_null());
        let normals = pictures.iter().any(|picture| !picture.normals.is_null());
        Ok(RenderOptions { normals, ..self.outputs(rgb, alpha, depth)? })
    }

    pub(super) fn outputs(&self, rgb: bool, alpha: bool, wants_depth: bool) -> Result<RenderOptions, Failure> {
        let depth = meaning("depth", self.depth, "zs_depth_mode", [Depth::Expected, Depth::Accumulated])?;
        let antialiased = zs_antialiasing::of(self.antialiasing)?;
        Ok(RenderOptions {
            rgb,
            alpha,
            depth: wants_depth.then_some(depth),
            background: self.background,
            near: (self.near_plane > 0.0).then_some(self.near_plane),
            antialiased,
            ..RenderOptions::default()
        })
    }
}

impl zs_render_buffers {
    /// # Safety
    /// Non-NULL pointers have capacity for the frame.
    unsafe fn write(&self, frame: &RenderOutput, format: zs_pixel_format, stride: isize) -> Result<(), Failure> {
        let planes = [
            ("alpha", self.alpha, &frame.alpha),
            ("depth", self.depth, &frame.depth),
            ("normals", self.normals, &frame.normals),
        ];
        for (name, to, from) in planes {
            if let (false, Some(from)) = (to.is_null(), from) {
                // SAFETY: the caller's promise.
                unsafe { array_mut(to, from.len(), name) }?.copy_from_slice(from);
            }
        }
        let (false, Some(rgb)) = (self.pixels.is_null(), &frame.rgb) else { return Ok(()) };
        let width = frame.width as usize;
        let alpha = frame.alpha.as_deref().unwrap_or_default();
        let row_bytes = width * format.bytes();
        for (y, colors) in rgb.chunks_exact(3 * width).enumerate() {
            // SAFETY: the caller's promise; the stride was checked not to wrap.
            let row = unsafe {
                std::slice::from_raw_parts_mut(self.pixels.cast::<u8>().offset(y as isize * stride), row_bytes)
            };
            encode_row(row, colors, alpha.get(y * width..).unwrap_or_default(), format);
        }
        Ok(())
    }
}

/// Encodes one row; `alpha` is filled if the format has it.
fn encode_row(row: &mut [u8], colors: &[f32], alpha: &[f32], format: zs_pixel_format) {
    let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0) as u8;
    let alpha_byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0).round_ties_even() as u8;
    let alphas = alpha.iter().copied().chain(std::iter::repeat(1.0));
    let pixels = row.chunks_exact_mut(format.bytes()).zip(colors.chunks_exact(3)).zip(alphas);
    for ((pixel, rgb), alpha) in pixels {
        let ([r, g, b], a) = ([rgb[0], rgb[1], rgb[2]].map(byte), alpha_byte(alpha));
        match format {
            zs_pixel_format::ZS_PIXEL_RGB8 => pixel.copy_from_slice(&[r, g, b]),
            zs_pixel_format::ZS_PIXEL_RGBA8 => pixel.copy_from_slice(&[r, g, b, a]),
            zs_pixel_format::ZS_PIXEL_BGRA8 => pixel.copy_from_slice(&[b, g, r, a]),
            zs_pixel_format::ZS_PIXEL_RGB_F32 => pixel.copy_from_slice(bytemuck::cast_slice(rgb)),
            zs_pixel_format::ZS_PIXEL_RGBA_F32 => {
                pixel.copy_from_slice(bytemuck::cast_slice(&[rgb[0], rgb[1], rgb[2], alpha]));
            }
        }
    }
}
