//! Scenes in arrays, files and bytes.

use super::{
    camera::{read_cameras, zs_camera},
    image::zs_image,
    pointers::{
        Versioned, array, borrow, describe, destroy, flag, optional_text, produce, put, read_array, read_given,
        read_versioned, text,
    },
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{c_char, c_void},
    ops::ControlFlow,
    sync::Arc,
};
use zipsplat::{
    SaveOptions, Scene,
    refine::stereo_points,
    types::{Origin, PointCloud, SceneFormat, World, decode_world, read_world},
};

pub struct zs_scene {
    pub(super) scene: Arc<Scene>,
    /// World of a file's scene, if stored.
    pub(super) world: Option<World>,
    pub(super) dropped: usize,
}

impl zs_scene {
    fn new(scene: impl Into<Arc<Scene>>) -> Self {
        Self { scene: scene.into(), world: None, dropped: 0 }
    }
}

impl From<Scene> for zs_scene {
    fn from(scene: Scene) -> Self {
        Self::new(scene)
    }
}

impl From<Arc<Scene>> for zs_scene {
    fn from(scene: Arc<Scene>) -> Self {
        Self::new(scene)
    }
}

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_world {
    ZS_WORLD_AUTO = 0,
    ZS_WORLD_FIRST_CAMERA = 1,
    ZS_WORLD_INPUT_CAMERAS = 2,
}

pub(super) type zs_world_value = i32;

pub struct zs_blob {
    bytes: Vec<u8>,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_gaussians {
    pub struct_size: u32,
    pub sh_degree: u32,
    pub count: usize,
    pub means: *const f32,
    pub scales: *const f32,
    pub quats: *const f32,
    pub opacities: *const f32,
    pub sh_coeffs: *const f32,
    pub antialiased: u32,
    pub reserved: u32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_scene_save_options {
    pub struct_size: u32,
    pub spz_version: u32,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_scene_open_options {
    pub struct_size: u32,
    pub drop_invalid: u32,
    pub format: *const c_char,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_scene_info {
    pub struct_size: u32,
    pub world: zs_world_value,
    pub gaussian_count: usize,
    pub dropped_count: usize,
}

versioned!(zs_gaussians { reserved }, zs_scene_save_options, zs_scene_open_options, zs_scene_info);

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_get_info(scene: *const zs_scene, info: *mut zs_scene_info) -> zs_status {
    let of = |zs_scene { scene, world, dropped }: &zs_scene| {
        let world = match world.as_ref().map(|world| &world.origin) {
            None => zs_world::ZS_WORLD_AUTO,
            Some(Origin::Photo(_)) => zs_world::ZS_WORLD_FIRST_CAMERA,
            Some(Origin::Cameras(_)) => zs_world::ZS_WORLD_INPUT_CAMERAS,
        } as i32;
        Ok(zs_scene_info { world, gaussian_count: scene.len(), dropped_count: *dropped, ..Versioned::new() })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(scene, "scene", info, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_get_gaussians(scene: *const zs_scene, gaussians: *mut zs_gaussians) -> zs_status {
    let of = |zs_scene { scene, .. }: &zs_scene| {
        Ok(zs_gaussians {
            sh_degree: scene.sh_degree,
            count: scene.len(),
            means: scene.means.as_ptr().cast(),
            scales: scene.scales.as_ptr().cast(),
            quats: scene.quats.as_ptr().cast(),
            opacities: scene.opacities.as_ptr(),
            sh_coeffs: scene.sh_coeffs.as_ptr().cast(),
            antialiased: scene.antialiased.into(),
            ..Versioned::new()
        })
    };
    // SAFETY: the caller's arguments.
    unsafe { describe(scene, "scene", gaussians, of) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_create(gaussians: *const zs_gaussians, scene: *mut *mut zs_scene) -> zs_status {
    let create = || {
        let mut scene = Scene::default();
        // SAFETY: the caller's arguments.
        unsafe { read_given(gaussians)?.copy_to(&mut scene) }?;
        scene.validate()?;
        Ok(scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, create) }
}

/// Keeps array sizes far from overflow; more Gaussians exceed any device's memory.
const MAX_GAUSSIANS: usize = 1 << 28;

impl zs_gaussians {
    /// Copies unchecked arrays, in place if `scene` has as many Gaussians.
    ///
    /// # Safety
    /// Pointers are NULL or have the documented lengths.
    pub(super) unsafe fn copy_to(&self, scene: &mut Scene) -> Result<(), Failure> {
        if self.sh_degree > Scene::MAX_SH_DEGREE {
            let expected = format!("0 to {}", Scene::MAX_SH_DEGREE);
            return Err(Failure::argument("gaussians, sh_degree", self.sh_degree, expected));
        }
        let n = self.count;
        if n > MAX_GAUSSIANS {
            return Err(Failure::argument("gaussians", n, format!("at most {MAX_GAUSSIANS}")));
        }
        fn fill<T: Copy>(to: &mut Vec<T>, from: &[T]) {
            to.clear();
            to.extend_from_slice(from);
        }
        let k = (self.sh_degree as usize + 1).pow(2);
        // SAFETY: the caller's promise.
        unsafe {
            fill(&mut scene.means, array(self.means.cast(), n, "means")?);
            fill(&mut scene.scales, array(self.scales.cast(), n, "scales")?);
            fill(&mut scene.quats, array(self.quats.cast(), n, "quats")?);
            fill(&mut scene.opacities, array(self.opacities, n, "opacities")?);
            fill(&mut scene.sh_coeffs, array(self.sh_coeffs.cast(), n * k, "sh_coeffs")?);
        }
        scene.sh_degree = self.sh_degree;
        scene.antialiased = flag("gaussians, antialiased", self.antialiased)?;
        Ok(())
    }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_from_points(
    positions: *const f32,
    colors: *const u8,
    count: usize,
    cameras: *const zs_camera,
    camera_count: usize,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let create = || {
        // SAFETY: the caller's arrays.
        let (cloud, cameras) = unsafe { (read_cloud(positions, colors, count)?, read_cameras(cameras, camera_count)?) };
        Ok(Scene::from_points(&cloud, &cameras)?.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, create) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_from_photos(
    images: *const zs_image,
    cameras: *const zs_camera,
    image_count: usize,
    positions: *const f32,
    colors: *const u8,
    count: usize,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let create = || {
        // SAFETY: the caller's arrays.
        let (cloud, photos, cameras) = unsafe {
            let images = read_array(images, image_count, "images")?.into_iter().enumerate();
            let photos = images.map(|(i, image)| image.image(&format!("image {i}"))).collect::<Result<Vec<_>, _>>()?;
            (read_cloud(positions, colors, count)?, photos, read_cameras(cameras, image_count)?)
        };
        let joined = stereo_points(&photos, &cameras, &cloud, None, |_| ControlFlow::Continue(()))?;
        Ok(Scene::from_points(&joined, &cameras)?.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, create) }
}

/// # Safety
/// Arrays have `count` rows; all may be NULL.
unsafe fn read_cloud(positions: *const f32, colors: *const u8, count: usize) -> Result<PointCloud, Failure> {
    if !(1..=MAX_GAUSSIANS).contains(&count) {
        return Err(Failure::argument("number of points", count, format!("1 to {MAX_GAUSSIANS}")));
    }
    // SAFETY: the caller's promise.
    let (positions, colors): (&[[f32; 3]], &[[u8; 3]]) = unsafe {
        let colors = if colors.is_null() { &[] } else { array(colors.cast(), count, "colors")? };
        (array(positions.cast(), count, "positions")?, colors)
    };
    if positions.as_flattened().iter().any(|value| !value.is_finite()) {
        return Err(Failure::argument("positions", "NaN or infinity", "finite numbers"));
    }
    Ok(PointCloud { positions: positions.to_vec(), colors: colors.to_vec() })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_open(
    path: *const c_char,
    options: *const zs_scene_open_options,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let open = || {
        // SAFETY: the caller's arguments.
        let (path, options) = unsafe { (text(path, "path")?, read_versioned(options)?) };
        if !options.format.is_null() {
            return Err(Failure::argument("format", "one for a file", "NULL: files are recognized"));
        }
        let scene = if options.drops()? { Scene::open_unchecked(path) } else { Scene::open(path) }?;
        Ok(zs_scene { world: read_world(path)?, ..options.checked(scene)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, open) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_from_memory(
    data: *const c_void,
    size: usize,
    options: *const zs_scene_open_options,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let decode = || {
        // SAFETY: the caller's arguments.
        let (bytes, options, format) = unsafe {
            let options = read_versioned(options)?;
            (array(data.cast::<u8>(), size, "bytes of a scene")?, options, optional_text(options.format, "format")?)
        };
        let format = format.map(format_named).transpose()?;
        let drops = options.drops()?;
        let scene = if drops { Scene::decode_unchecked(bytes, format) } else { Scene::decode(bytes, format) }?;
        Ok(zs_scene { world: decode_world(bytes, format)?, ..options.checked(scene)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, decode) }
}

impl zs_scene_open_options {
    fn drops(&self) -> Result<bool, Failure> {
        flag("drop_invalid", self.drop_invalid)
    }

    fn checked(&self, mut scene: Scene) -> Result<zs_scene, Failure> {
        let dropped = if self.drops()? { scene.drop_invalid()? } else { 0 };
        Ok(zs_scene { dropped, ..scene.into() })
    }
}

impl zs_scene_save_options {
    fn engine(&self) -> SaveOptions {
        match self.spz_version {
            0 => SaveOptions::default(),
            spz_version => SaveOptions { spz_version },
        }
    }
}

fn format_named(name: &str) -> Result<SceneFormat, Failure> {
    SceneFormat::named(name).ok_or_else(|| Failure::argument("format", name, SceneFormat::EXTENSIONS))
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_save(
    scene: *const zs_scene,
    path: *const c_char,
    options: *const zs_scene_save_options,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (scene, path, options) =
            unsafe { (borrow(scene, "scene")?, text(path, "path")?, read_versioned(options)?) };
        Ok(scene.scene.save_in(path, &options.engine(), scene.world.as_ref())?)
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_to_memory(
    scene: *const zs_scene,
    format: *const c_char,
    options: *const zs_scene_save_options,
    bytes: *mut *mut zs_blob,
) -> zs_status {
    let encode = || {
        // SAFETY: the caller's arguments.
        let (scene, format, options) =
            unsafe { (borrow(scene, "scene")?, text(format, "format")?, read_versioned(options)?) };
        Ok(zs_blob { bytes: scene.scene.encode(format_named(format)?, &options.engine(), scene.world.as_ref())? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(bytes, encode) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_blob_get(bytes: *const zs_blob, data: *mut *const c_void, size: *mut usize) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let found = &unsafe { borrow(bytes, "bytes") }?.bytes;
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(data, found.as_ptr().cast(), "data").and_then(|()| put(size, found.len(), "size")) }
    })
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_blob_destroy(bytes: *mut zs_blob) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(bytes) }
}

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_destroy(scene: *mut zs_scene) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(scene) }
}
