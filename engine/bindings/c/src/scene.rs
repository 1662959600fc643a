//! Scenes: Gaussians in and out of arrays, files and bytes.

use super::{
    picture::zs_camera,
    pointers::{
        POINTER, Versioned, array, array_mut, borrow, destroy, optional_text, produce, read_array, read_given,
        read_versioned, text, write_defaults, write_versioned,
    },
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{c_char, c_void},
    sync::{Arc, Mutex},
};
use zipsplat::types::{
    Camera, Pose, Scene, SceneFormat, WriteOptions, decode_scene, decode_scene_unchecked, encode_scene,
    preprocess::PixelMap, read_scene, read_scene_unchecked, write_scene,
};
use zipsplat::{
    Error,
    gpu::Arena,
    reconstruct::{Patches, SceneTokens},
    refine::FrozenHead,
    stages::render::{DeviceScene, Renderer, WeakScene},
};

/// 3D Gaussians in host memory. A scene never changes, so any number of threads may use it at the same time. It belongs to no
/// context: it outlives devices, also lost ones. A renderer copies what it needs, so a scene may be destroyed before it.
pub struct zs_scene {
    pub(super) scene: Scene,
    /// The same Gaussians on a device, for as long as the model that made them keeps them there.
    pub(super) on_device: Option<WeakScene>,
    /// The tokens that a model made it of, where that model keeps them.
    pub(super) tokens: Option<ModelTokens>,
    /// Where its Gaussians were seen, where it was made of photos without cameras.
    pub(super) seen: Option<Seen>,
}

/// The tokens of a scene, and what makes Gaussians of them.
pub(super) struct ModelTokens {
    pub tokens: SceneTokens,
    pub head: Arc<FrozenHead>,
    /// The model's.
    pub arena: Arena,
    /// The pose in the scene's world of its first camera, where that is another than the world.
    pub pose: Option<Pose>,
}

/// Photos without cameras that a scene was made of.
pub(super) struct Seen {
    pub patches: Patches,
    /// From each photo to what the network saw of it.
    pub maps: Vec<PixelMap>,
}

/// A model's latest scene, kept on its device.
pub(super) type LatestScene = Mutex<Option<DeviceScene>>;

impl zs_scene {
    /// A scene that a model just made, in place of the one that it made before.
    pub(super) fn on_device(scene: Scene, latest: &LatestScene, gaussians: DeviceScene) -> Self {
        let on_device = Some(gaussians.downgrade());
        *latest.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(gaussians);
        Self { scene, on_device, tokens: None, seen: None }
    }

    /// With the photos that it was made of.
    pub(super) fn seen(self, seen: Option<Seen>) -> Self {
        Self { seen, ..self }
    }

    /// Lets a renderer draw it: from the device's own Gaussians where they still are there.
    pub(super) fn load(&self, renderer: &mut Renderer) -> Result<(), Error> {
        let shown = self.on_device.as_ref().and_then(WeakScene::upgrade).map(|gaussians| renderer.show(&gaussians));
        match shown {
            Some(Ok(())) => Ok(()),
            _ => renderer.load(&self.scene),
        }
    }
}

impl From<Scene> for zs_scene {
    fn from(scene: Scene) -> Self {
        Self { scene, on_device: None, tokens: None, seen: None }
    }
}

/// Bytes of the library's, such as a scene's file in memory. They never change.
pub struct zs_bytes {
    bytes: Vec<u8>,
}

/// Gaussians as arrays, one a property, each as long as it says.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_gaussians {
    /// sizeof(zs_gaussians); set it before the call.
    pub struct_size: u32,
    /// Highest band of spherical harmonics, 0 to 3. There are K = (sh_degree + 1)^2 coefficients a Gaussian and channel.
    pub sh_degree: u32,
    /// N, the number of Gaussians.
    pub count: u64,
    /// N x 3 centres.
    pub means: *const f32,
    /// N x 3 standard deviations along the Gaussian's own axes: linear, not logarithms; not negative.
    pub scales: *const f32,
    /// N x 4 rotations as quaternions w, x, y, z; of any length but zero.
    pub quats: *const f32,
    /// N opacities from 0 to 1.
    pub opacities: *const f32,
    /// N x K x 3 coefficients of spherical harmonics for red, green, blue: those of 3D Gaussian Splatting's files. The basis is
    /// real and orthonormal, band after band and from m = -l to l in each, negative where m is odd. It begins with 0.282095,
    /// -0.488603 y, 0.488603 z, -0.488603 x, where (x, y, z) is the unit vector in the world from the camera to the Gaussian's
    /// centre. Colour is 0.5 plus the sum of basis times coefficients, and not below 0.
    pub sh_coeffs: *const f32,
}

/// Options of writing a scene.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_save_options {
    /// sizeof(zs_save_options); zs_save_options_default sets it.
    pub struct_size: u32,
    /// Version of an SPZ: 3; 2 for older readers; 4, packed by zstd, for those that know only the newest. Default 3.
    pub spz_version: u32,
}

// SAFETY: repr(C), two u32, a u64 and pointers: no padding.
unsafe impl Versioned for zs_gaussians {
    const NAME: &str = "zs_gaussians";
    const FIRST_SIZE: usize = 16 + 5 * POINTER;
    fn defaults() -> Self {
        let none = std::ptr::null();
        let struct_size = size_of::<Self>() as u32;
        Self {
            struct_size,
            sh_degree: 0,
            count: 0,
            means: none,
            scales: none,
            quats: none,
            opacities: none,
            sh_coeffs: none,
        }
    }
}

// SAFETY: repr(C), two u32: no padding.
unsafe impl Versioned for zs_save_options {
    const NAME: &str = "zs_save_options";
    const FIRST_SIZE: usize = 8;
    fn defaults() -> Self {
        Self { struct_size: size_of::<Self>() as u32, spz_version: WriteOptions::default().spz_version }
    }
}

/// Fills `gaussians` with how large a scene is and where its arrays are: the scene's own memory, there until it is destroyed.
/// Set its struct_size before the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_get_gaussians(scene: *const zs_scene, gaussians: *mut zs_gaussians) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL.
        let scene = &unsafe { borrow(scene, "scene") }?.scene;
        let found = zs_gaussians {
            sh_degree: scene.sh_degree,
            count: scene.len() as u64,
            means: scene.means.as_ptr().cast(),
            scales: scene.scales.as_ptr().cast(),
            quats: scene.quats.as_ptr().cast(),
            opacities: scene.opacities.as_ptr(),
            sh_coeffs: scene.sh_coeffs.as_ptr().cast(),
            ..Versioned::defaults()
        };
        // SAFETY: the caller's structure.
        unsafe { write_versioned(gaussians, found) }
    })
}

/// Makes a scene of your arrays, which are copied. All of them must be there, and every value finite and in its range.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_create(gaussians: *const zs_gaussians, scene: *mut *mut zs_scene) -> zs_status {
    let create = || {
        // SAFETY: the caller's structure.
        let arrays = unsafe { read_given(gaussians) }?;
        if arrays.sh_degree > Scene::MAX_SH_DEGREE {
            let expected = format!("0 to {}", Scene::MAX_SH_DEGREE);
            return Err(Failure::argument("gaussians, sh_degree", arrays.sh_degree, expected));
        }
        let n = usize::try_from(arrays.count).ok().filter(|n| *n <= MAX_GAUSSIANS);
        let n = n.ok_or_else(|| Failure::argument("gaussians", arrays.count, format!("at most {MAX_GAUSSIANS}")))?;
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

/// More fill no device's memory, and their arrays' sizes stay far from wrapping.
const MAX_GAUSSIANS: usize = 1 << 28;

/// Reads a scene file: PLY of 3D Gaussian Splatting, also packed (.compressed.ply), SPZ, .splat, glTF with KHR_gaussian_splatting
/// (.gltf, .glb). Whatever axes the format has, the scene's are x right, y down, z forward. `path` is UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_open(path: *const c_char, scene: *mut *mut zs_scene) -> zs_status {
    // SAFETY: a string or NULL.
    let open = || Ok(read_scene(unsafe { text(path, "path") }?)?.into());
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, open) }
}

/// As zs_scene_open, which refuses a file with values that are NaN, infinite or out of range: here Gaussians with such values are
/// left out, and `dropped` gets their number. `dropped` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_open_dropping_invalid(
    path: *const c_char,
    dropped: *mut u64,
    scene: *mut *mut zs_scene,
) -> zs_status {
    let open = || {
        // SAFETY: a string or NULL.
        let mut scene = read_scene_unchecked(unsafe { text(path, "path") }?)?;
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

/// As zs_scene_open, with a file's contents: `size` bytes at `data`, which are not needed any more when this returns. PLY, SPZ and
/// .glb are told apart by their first bytes; `format` names one that they do not tell ("splat", "gltf"), and may be NULL. A
/// glTF may name no other file. Where `dropped` is not NULL, Gaussians with values that are NaN, infinite or out of range are left
/// out and it gets their number; where it is NULL, such a scene is refused.
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
            return Ok(decode_scene(bytes, format)?.into());
        }
        let mut scene = decode_scene_unchecked(bytes, format)?;
        let count = scene.drop_invalid()? as u64;
        // SAFETY: not NULL, and the caller's to write.
        unsafe { dropped.write(count) };
        Ok(scene.into())
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(scene, decode) }
}

fn format_named(name: &str) -> Result<SceneFormat, Failure> {
    SceneFormat::named(name).ok_or_else(|| Failure::argument("format", name, SceneFormat::EXTENSIONS))
}

/// Fills `options` with the defaults. `size` is sizeof(zs_save_options).
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_save_options_default(options: *mut zs_save_options, size: usize) -> zs_status {
    // SAFETY: the caller's structure of that size.
    unsafe { write_defaults(options, size) }
}

/// Writes a scene in the format of the path's extension: .ply, .spz, .splat, .gltf or .glb. The file appears whole or not at
/// all; one of that name is replaced. `options` may be NULL. `path` is UTF-8.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_save(
    scene: *const zs_scene,
    path: *const c_char,
    options: *const zs_save_options,
) -> zs_status {
    guard(|| {
        // SAFETY: an object or NULL, a string or NULL, a structure or NULL.
        let (scene, path, options) =
            unsafe { (borrow(scene, "scene")?, text(path, "path")?, read_versioned(options)?) };
        Ok(write_scene(path, &scene.scene, &WriteOptions { spz_version: options.spz_version })?)
    })
}

/// As zs_scene_save, to memory: what the file of `format` ("ply", "spz", "splat", "gltf" or "glb") would have is handed out
/// as an object, which is yours to destroy. `options` may be NULL.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_to_memory(
    scene: *const zs_scene,
    format: *const c_char,
    options: *const zs_save_options,
    bytes: *mut *mut zs_bytes,
) -> zs_status {
    let encode = || {
        // SAFETY: an object or NULL, a string or NULL, a structure or NULL.
        let (scene, format, options) =
            unsafe { (borrow(scene, "scene")?, text(format, "format")?, read_versioned(options)?) };
        let options = WriteOptions { spz_version: options.spz_version };
        Ok(zs_bytes { bytes: encode_scene(&scene.scene, format_named(format)?, &options)? })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(bytes, encode) }
}

/// Says where bytes are and how many: the object's own memory, there until it is destroyed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_bytes_get(bytes: *const zs_bytes, data: *mut *const c_void, size: *mut usize) -> zs_status {
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

/// Finds the cameras of the photos of a scene that zs_reconstruct made of `count` photos without cameras, in the scene's world: from
/// where the Gaussians of each of a photo's patches are. The photos are taken to share a field of view, which is found, too.
/// `cameras` is an array of `count`, each with its struct_size set; each gets the camera of the whole photo. `inliers` gets the number
/// of patches that agree with it and `patches` how many there were; both are arrays of `count` or NULL. A photo whose
/// camera is not found has a camera of width 0 and no inliers; where none is found, that is an error.
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
        let Some(Seen { patches: seen, maps }) = seen else {
            let expected = "one that zs_reconstruct made of photos without cameras";
            return Err(Failure::argument("scene to find cameras of", "another", expected));
        };
        if count != maps.len() {
            return Err(Failure::argument("number of cameras", count, format!("{}, one a photo", maps.len())));
        }
        // SAFETY: the caller's arrays; those that may be NULL are looked at only where they are not.
        let (given, mut inliers, mut patches) = unsafe {
            let counts = |at: *mut u32, name| (!at.is_null()).then(|| array_mut(at, count, name)).transpose();
            (read_array(cameras, count, "cameras")?, counts(inliers, "inliers")?, counts(patches, "patches")?)
        };
        let mut found = seen.cameras(scene, None)?;
        if found.iter().all(Result::is_err) {
            return Err(found.swap_remove(0).err().unwrap_or(Error::Cancelled).into());
        }
        for (i, (found, map)) in found.into_iter().zip(maps).enumerate() {
            let camera = found.as_ref().map_or(Versioned::defaults(), |found| {
                zs_camera::from(&Camera { intrinsics: map.undo(&found.camera.intrinsics), ..found.camera })
            });
            // SAFETY: the caller's array of structures, all as long as the first, as was just checked.
            unsafe { write_versioned(cameras.byte_add(i * given[0].struct_size as usize), camera) }?;
            let counts = found.map_or([0; 2], |found| [found.inliers, found.pairs]);
            for (array, number) in [&mut inliers, &mut patches].into_iter().zip(counts) {
                array.iter_mut().for_each(|array| array[i] = number as u32);
            }
        }
        Ok(())
    })
}

/// Destroys bytes. NULL is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_bytes_destroy(bytes: *mut zs_bytes) {
    // SAFETY: an object that the caller gives up, or NULL.
    unsafe { destroy(bytes) }
}

/// Destroys a scene. NULL is allowed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_scene_destroy(scene: *mut zs_scene) {
    // SAFETY: an object that the caller gives up, or NULL.
    unsafe { destroy(scene) }
}
