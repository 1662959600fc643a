//! Scenes: Gaussians from and to arrays, files and bytes.

use super::{
    camera::zs_camera,
    pointers::{
        Versioned, array, array_mut, borrow, destroy, optional_text, produce, read_array, read_given, read_versioned,
        text, write_versioned,
    },
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{c_char, c_void},
    sync::{Arc, Mutex},
};
use zipsplat::types::{Camera, Pose, SaveOptions, Scene, SceneFormat, preprocess::PixelMap};
use zipsplat::{
    Error,
    gpu::Arena,
    reconstruct::{Patches, SceneTokens},
    refine::FrozenHead,
    stages::render::{DeviceScene, Renderer, WeakScene},
};

/// 3D Gaussians in host memory. Independent of devices; survives device loss.
pub struct zs_scene {
    pub(super) scene: Scene,
    /// The device copy, while its model keeps it.
    pub(super) on_device: Option<WeakScene>,
    pub(super) tokens: Option<ModelTokens>,
    /// Pixel positions of its Gaussians, for scenes from photos without cameras.
    pub(super) seen: Option<PatchViews>,
}

pub(super) struct ModelTokens {
    pub tokens: SceneTokens,
    pub head: Arc<FrozenHead>,
    pub arena: Arena,
    /// The first camera's pose in the scene's world, if the world is not that camera's space.
    pub pose: Option<Pose>,
}

pub(super) struct PatchViews {
    pub patches: Patches,
    /// Maps from each photo to the network's input.
    pub maps: Vec<PixelMap>,
}

pub(super) type LatestScene = Mutex<Option<DeviceScene>>;

impl zs_scene {
    /// Wraps a model's new scene and releases the previous device copy.
    pub(super) fn on_device(scene: Scene, latest: &LatestScene, gaussians: DeviceScene) -> Self {
        let on_device = Some(gaussians.downgrade());
        *latest.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(gaussians);
        Self { scene, on_device, tokens: None, seen: None }
    }

    pub(super) fn seen(self, seen: Option<PatchViews>) -> Self {
        Self { seen, ..self }
    }

    pub(super) fn load(&self, renderer: &mut Renderer) -> Result<(), Error> {
        let shown =
            self.on_device.as_ref().and_then(WeakScene::upgrade).map(|gaussians| renderer.set_scene(&gaussians));
        match shown {
            Some(Ok(())) => Ok(()),
            _ => renderer.set_scene(&self.scene),
        }
    }
}

impl From<Scene> for zs_scene {
    fn from(scene: Scene) -> Self {
        Self { scene, on_device: None, tokens: None, seen: None }
    }
}

/// Bytes owned by the library, such as an encoded scene file.
pub struct zs_blob {
    bytes: Vec<u8>,
}

/// Gaussians as one array per property.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_gaussians {
    /// sizeof(zs_gaussians).
    pub struct_size: u32,
    /// Degree of spherical harmonics, 0 to 3: K = (sh_degree + 1)^2 coefficients per channel.
    pub sh_degree: u32,
    /// N.
    pub count: usize,
    /// N x 3 centers.
    pub means: *const f32,
    /// N x 3 linear standard deviations, not negative.
    pub scales: *const f32,
    /// N x 4 quaternions w, x, y, z of any length but zero.
    pub quats: *const f32,
    /// N opacities from 0 to 1.
    pub opacities: *const f32,
    /// N x K x 3 coefficients of spherical harmonics for red, green, blue, as in 3D Gaussian
    /// Splatting. The basis is real and orthonormal, by band, then m = -l to l, negative for odd m.
    /// It begins with 0.282095, -0.488603 y, 0.488603 z, -0.488603 x. (x, y, z) is the unit vector
    /// in the world from the camera to the Gaussian's center. Color is max(0, 0.5 + sum of basis
    /// times coefficients).
    pub sh_coeffs: *const f32,
}

/// Options of zs_scene_save.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_scene_save_options {
    /// sizeof(zs_scene_save_options).
    pub struct_size: u32,
    /// SPZ version: 2, 3 or 4 (zstd); 0 is 3.
    pub spz_version: u32,
}

versioned!(zs_gaussians, zs_scene_save_options);

/// Returns the scene's size and arrays, which point into the scene.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_get_gaussians(scene: *const zs_scene, gaussians: *mut zs_gaussians) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let scene = &unsafe { borrow(scene, "scene") }?.scene;
        let found = zs_gaussians {
            sh_degree: scene.sh_degree,
            count: scene.len(),
            means: scene.means.as_ptr().cast(),
            scales: scene.scales.as_ptr().cast(),
            quats: scene.quats.as_ptr().cast(),
            opacities: scene.opacities.as_ptr(),
            sh_coeffs: scene.sh_coeffs.as_ptr().cast(),
            ..Versioned::new()
        };
        // SAFETY: the caller's structure.
        unsafe { write_versioned(gaussians, found) }
    })
}

/// Creates a scene from copies of arrays. All are required, with finite values in their range.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_create(gaussians: *const zs_gaussians, scene: *mut *mut zs_scene) -> zs_status {
    let create = || {
        // SAFETY: the caller's structure.
        let arrays = unsafe { read_given(gaussians) }?;
        if arrays.sh_degree > Scene::MAX_SH_DEGREE {
            let expected = format!("0 to {}", Scene::MAX_SH_DEGREE);
            return Err(Failure::argument("gaussians, sh_degree", arrays.sh_degree, expected));
        }
        let n = arrays.count;
        if n > MAX_GAUSSIANS {
            return Err(Failure::argument("gaussians", n, format!("at most {MAX_GAUSSIANS}")));
        }
        let k = (arrays.sh_degree as usize + 1).pow(2);
        // SAFETY: the caller says that every array has as many elements.
        let scene = unsafe {
            Scene {
                means: array::<[f32; 3]>(arrays.means.cast(), n, "means")?.to_vec(),
                scales: array::<[f32; 3]>(arrays.scales.cast(), n, "scales")?.to_vec(),
                quats: array::<[f32; 4]>(arrays.quats.cast(), n, "quats")?.to_vec(),
                opacities: array::<f32>(arrays.opacities, n, "opacities")?.to_vec(),
                sh_coeffs: array::<[f32; 3]>(arrays.sh_coeffs.cast(), n.saturating_mul(k), "sh_coeffs")?.to_vec(),
                sh_degree: arrays.sh_degree,
            }
        };
        scene.validate()?;
        Ok(scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, create) }
}

/// Keeps array sizes far from overflow; more Gaussians exceed any device's memory.
const MAX_GAUSSIANS: usize = 1 << 28;

/// Opens a scene file: PLY of 3D Gaussian Splatting, .compressed.ply, SPZ, .splat, or glTF with
/// KHR_gaussian_splatting (.gltf, .glb). Rejects NaN, infinite and out-of-range values.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_open(path: *const c_char, scene: *mut *mut zs_scene) -> zs_status {
    // SAFETY: a string or NULL.
    let open = || Ok(Scene::open(unsafe { text(path, "path") }?)?.into());
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, open) }
}

/// Opens a scene file without its invalid Gaussians. `dropped` receives their number and may be
/// NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_open_dropping_invalid(
    path: *const c_char,
    dropped: *mut u64,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let open = || {
        // SAFETY: a string or NULL.
        let mut scene = Scene::open_unchecked(unsafe { text(path, "path") }?)?;
        let count = scene.drop_invalid()? as u64;
        if !dropped.is_null() {
            // SAFETY: not NULL, and the caller's to write.
            unsafe { dropped.write(count) };
        }
        Ok(scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, open) }
}

/// Decodes a scene from `size` bytes at `data`, as zs_scene_open. `format` is NULL for PLY, SPZ and
/// .glb, which are recognized by content, else "splat" or "gltf". A glTF must not refer to other
/// files. If `dropped` is not NULL, invalid Gaussians are dropped and counted there; otherwise they
/// are an error.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_from_memory(
    data: *const c_void,
    size: usize,
    format: *const c_char,
    dropped: *mut u64,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let decode = || {
        // SAFETY: the caller's array of that size, and a string or NULL.
        let (bytes, format) =
            unsafe { (array(data.cast::<u8>(), size, "bytes of a scene")?, optional_text(format, "format")?) };
        let format = format.map(format_named).transpose()?;
        if dropped.is_null() {
            return Ok(Scene::decode(bytes, format)?.into());
        }
        let mut scene = Scene::decode_unchecked(bytes, format)?;
        let count = scene.drop_invalid()? as u64;
        // SAFETY: not NULL, and the caller's to write.
        unsafe { dropped.write(count) };
        Ok(scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, decode) }
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

/// Writes a scene in the format of the path's extension: .ply, .spz, .splat, .gltf or .glb. An
/// existing file is replaced atomically.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_save(
    scene: *const zs_scene,
    path: *const c_char,
    options: *const zs_scene_save_options,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL, a string or NULL, a structure or NULL.
        let (scene, path, options) =
            unsafe { (borrow(scene, "scene")?, text(path, "path")?, read_versioned(options)?) };
        Ok(scene.scene.save_with(path, &options.engine())?)
    })
}

/// Encodes a scene to memory. `format` is "ply", "spz", "splat", "gltf" or "glb".
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_to_memory(
    scene: *const zs_scene,
    format: *const c_char,
    options: *const zs_scene_save_options,
    bytes: *mut *mut zs_blob,
) -> zs_status {
    let encode = || {
        // SAFETY: an object or NULL, a string or NULL, a structure or NULL.
        let (scene, format, options) =
            unsafe { (borrow(scene, "scene")?, text(format, "format")?, read_versioned(options)?) };
        Ok(zs_blob { bytes: scene.scene.encode(format_named(format)?, &options.engine())? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(bytes, encode) }
}

/// Returns address and size of the bytes, which belong to the object.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_blob_get(bytes: *const zs_blob, data: *mut *const c_void, size: *mut usize) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let found = &unsafe { borrow(bytes, "bytes") }?.bytes;
        if data.is_null() || size.is_null() {
            return Err(Failure::argument("data and size", "NULL", "where to put them"));
        }
        // SAFETY: not NULL, and the caller's to write.
        unsafe { data.write(found.as_ptr().cast()) };
        // SAFETY: as above.
        unsafe { size.write(found.len()) };
        Ok(())
    })
}

/// Estimates the cameras of the `count` unposed photos of a scene from zs_reconstruct, in the
/// scene's world. They follow from the Gaussians of each photo's patches and share an estimated
/// field of view.
///
/// `cameras` is an array of `count` with struct_size set, for the cameras of the whole photos.
/// `inliers` receives the number of consistent patches and `patches` the total; both are arrays of
/// `count` or NULL. A photo without a camera gets width 0 and no inliers. No camera at all is an
/// error.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_cameras(
    scene: *const zs_scene,
    cameras: *mut zs_camera,
    inliers: *mut u32,
    patches: *mut u32,
    count: usize,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let zs_scene { scene, seen, .. } = unsafe { borrow(scene, "scene") }?;
        let Some(PatchViews { patches: seen, maps }) = seen else {
            let expected = "one that zs_reconstruct made of photos without cameras";
            return Err(Failure::argument("scene to find cameras of", "another", expected));
        };
        if count != maps.len() {
            return Err(Failure::argument("number of cameras", count, format!("{}, one a photo", maps.len())));
        }
        // SAFETY: the caller's arrays; optional ones are accessed only if not NULL.
        let (given, mut inliers, mut patches) = unsafe {
            let counts = |at: *mut u32, name| (!at.is_null()).then(|| array_mut(at, count, name)).transpose();
            (read_array(cameras, count, "cameras")?, counts(inliers, "inliers")?, counts(patches, "patches")?)
        };
        let mut found = seen.cameras(scene, None)?;
        if found.iter().all(Result::is_err) {
            return Err(found.swap_remove(0).err().unwrap_or(Error::Cancelled).into());
        }
        for (i, (found, map)) in found.into_iter().zip(maps).enumerate() {
            let camera = found.as_ref().map_or(Versioned::new(), |found| {
                zs_camera::from(&Camera { intrinsics: map.undo(&found.camera.intrinsics), ..found.camera })
            });
            // SAFETY: the caller's array; its elements were just checked to have equal sizes.
            unsafe { write_versioned(cameras.byte_add(i * given[0].struct_size as usize), camera) }?;
            let counts = found.map_or([0; 2], |found| [found.inliers, found.pairs]);
            for (array, number) in [&mut inliers, &mut patches].into_iter().zip(counts) {
                array.iter_mut().for_each(|array| array[i] = number as u32);
            }
        }
        Ok(())
    })
}

/// Destroys bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_blob_destroy(bytes: *mut zs_blob) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(bytes) }
}

/// Destroys a scene.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_destroy(scene: *mut zs_scene) {
    // SAFETY: NULL or given up by the caller.
    unsafe { destroy(scene) }
}
