//! The caller's own Vulkan device, images and buffers.

use super::{
    camera::zs_camera,
    device::{cached_in, zs_device},
    image::zs_pixel_format,
    pointers::{array, borrow, produce, put, read_given, read_versioned},
    renderer::{zs_render_options, zs_renderer},
    status::{Failure, guard, zs_status},
};
use std::{
    ffi::{c_char, c_void},
    sync::LazyLock,
};
use zipsplat::{
    gpu::{Adopted, Device, ImagePlace, Point, QueueLock, Requirement, Target, fast_requirements, requirements},
    stages::render::PixelLayout,
};

/// Kind of a zs_vulkan_requirement.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_requirement_kind {
    /// `name` is the minimum API version, as "1.3", of VkApplicationInfo and the device.
    ZS_REQUIRES_API_VERSION = 0,
    /// `name` is a device extension.
    ZS_REQUIRES_DEVICE_EXTENSION = 1,
    /// `name` is a field of `structure` to set to VK_TRUE at device creation.
    ZS_REQUIRES_FEATURE = 2,
}

pub(super) type zs_requirement_kind_value = i32;

/// A requirement for the caller's device.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_vulkan_requirement {
    /// Kind.
    pub kind: zs_requirement_kind_value,
    /// 1 if only faster precisions need it. Enable all that the device supports, then set
    /// zs_vulkan_device.optional_features_enabled.
    pub optional: u32,
    /// Vulkan's name; static.
    pub name: *const c_char,
    /// Static; "" unless a feature.
    pub structure: *const c_char,
}

/// vkGetInstanceProcAddr, cast to a function without arguments.
pub type zs_vulkan_function = Option<unsafe extern "C" fn()>;

/// Locks or unlocks a queue. Must not call this library.
pub type zs_queue_lock = Option<unsafe extern "C" fn(user_data: *mut c_void)>;

/// Borrowed Vulkan handles, never destroyed.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_vulkan_device {
    /// sizeof(zs_vulkan_device).
    pub struct_size: u32,
    /// Family of `queue`, with compute support.
    pub queue_family: u32,
    /// vkGetInstanceProcAddr; NULL uses the system's loader.
    pub get_instance_proc_addr: zs_vulkan_function,
    /// VkInstance.
    pub instance: *mut c_void,
    /// VkPhysicalDevice.
    pub physical_device: *mut c_void,
    /// VkDevice.
    pub device: *mut c_void,
    /// VkQueue. Submissions happen only on calling threads.
    pub queue: *mut c_void,
    /// Called before each submission to `queue`, and `unlock_queue` right after it, on the same
    /// thread. Do not hold the lock when calling the library. NULL if the queue is not shared.
    pub lock_queue: zs_queue_lock,
    /// NULL exactly if `lock_queue` is.
    pub unlock_queue: zs_queue_lock,
    /// Argument of both callbacks.
    pub user_data: *mut c_void,
    /// 1 if every supported optional requirement is enabled. 0 allows only ZS_PRECISION_FP32.
    pub optional_features_enabled: u32,
    /// 0.
    pub reserved: u32,
    /// As zs_device_options.cache_dir.
    pub cache_dir: *const c_char,
}

/// A value of a caller's timeline semaphore.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_semaphore_point {
    /// Timeline VkSemaphore, cast to uint64_t.
    pub semaphore: u64,
    /// Value to wait for or to signal.
    pub value: u64,
}

/// A caller's image or buffer as a copy destination. Handles are cast to uint64_t and must outlive
/// the signals or, without signals, the renderer.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_vulkan_target {
    /// sizeof(zs_vulkan_target).
    pub struct_size: u32,
    /// 0.
    pub reserved: u32,
    /// VkImage with VK_IMAGE_USAGE_TRANSFER_DST_BIT, one sample and the zs_pixel_format's format,
    /// owned by the queue's family or shared. 0 for a buffer.
    pub image: u64,
    /// First column; the camera's size must fit from there.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Mip level.
    pub mip_level: u32,
    /// Array layer.
    pub array_layer: u32,
    /// VkImageLayout after the waits.
    pub old_layout: i32,
    /// VkImageLayout at the signals; 0 is VK_IMAGE_LAYOUT_SHADER_READ_ONLY_OPTIMAL.
    pub new_layout: i32,
    /// VkBuffer with VK_BUFFER_USAGE_TRANSFER_DST_BIT and contiguous rows; 0 for an image.
    pub buffer: u64,
    /// First byte, a multiple of 4.
    pub buffer_offset: u64,
    /// Writable bytes from there.
    pub buffer_size: u64,
    /// Number of `waits`.
    pub wait_count: usize,
    /// Number of `signals`.
    pub signal_count: usize,
    /// Waited for before writing.
    pub waits: *const zs_semaphore_point,
    /// Signaled when the picture is written and visible.
    pub signals: *const zs_semaphore_point,
}

versioned!(zs_vulkan_device, zs_vulkan_target);

const SHADER_READ_ONLY: i32 = 5;

struct Requirements(Vec<zs_vulkan_requirement>);

// SAFETY: the data behind these pointers is never written.
unsafe impl Send for Requirements {}
// SAFETY: as above.
unsafe impl Sync for Requirements {}

static REQUIREMENTS: LazyLock<Requirements> = LazyLock::new(|| {
    let entry = |(requirement, optional): (Requirement, u32)| {
        let (kind, name, structure) = match requirement {
            Requirement::ApiVersion(version) => (zs_requirement_kind::ZS_REQUIRES_API_VERSION, version, c""),
            Requirement::DeviceExtension(name) => (zs_requirement_kind::ZS_REQUIRES_DEVICE_EXTENSION, name, c""),
            Requirement::Feature { name, structure } => (zs_requirement_kind::ZS_REQUIRES_FEATURE, name, structure),
        };
        zs_vulkan_requirement { kind: kind as i32, optional, name: name.as_ptr(), structure: structure.as_ptr() }
    };
    let [needed, optional] = [(requirements(), 0), (fast_requirements(), 1)]
        .map(|(list, optional)| list.into_iter().map(move |requirement| (requirement, optional)));
    Requirements(needed.chain(optional).map(entry).collect())
});

/// Lists the requirements of zs_device_from_vulkan.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_vulkan_requirements(
    list: *mut *const zs_vulkan_requirement,
    count: *mut usize,
) -> zs_status {
    guard(|| {
        let Requirements(found) = &*REQUIREMENTS;
        // SAFETY: the caller's to write, or NULL.
        unsafe { put(list, found.as_ptr(), "list").and_then(|()| put(count, found.len(), "count")) }
    })
}

/// Adopts the caller's device. All required features must be enabled; this cannot be checked.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_from_vulkan(
    vulkan: *const zs_vulkan_device,
    device: *mut *mut zs_device,
) -> zs_status {
    let adopt = || {
        // SAFETY: the caller's structure.
        let given = unsafe { read_versioned(vulkan) }?;
        if given.reserved != 0 {
            return Err(Failure::argument("zs_vulkan_device.reserved", given.reserved, "0"));
        }
        let user_data = UserData(given.user_data);
        let queue_lock = match (given.lock_queue, given.unlock_queue) {
            (Some(lock), Some(unlock)) => Some(QueueLock {
                // SAFETY: the caller's functions and data, valid on any calling thread.
                lock: Box::new(move || unsafe { lock(user_data.get()) }),
                // SAFETY: as above.
                unlock: Box::new(move || unsafe { unlock(user_data.get()) }),
            }),
            (None, None) => None,
            _ => return Err(Failure::argument("lock_queue and unlock_queue", "one of them", "both or none")),
        };
        let adopted = Adopted {
            get_instance_proc_addr: given.get_instance_proc_addr,
            instance: given.instance,
            physical_device: given.physical_device,
            device: given.device,
            queue: given.queue,
            queue_family: given.queue_family,
            queue_lock,
            fast: given.optional_features_enabled != 0,
            // SAFETY: the caller's arguments.
            cache_dir: unsafe { cached_in(given.cache_dir) }?,
        };
        // SAFETY: the caller guarantees valid handles.
        Ok(zs_device { gpu: unsafe { Device::adopt(adopted) }?, adopted: true })
    };
    // SAFETY: the caller's pointer.
    unsafe { produce(device, adopt) }
}

/// A caller's pointer for callbacks on any thread.
#[derive(Clone, Copy)]
struct UserData(*mut c_void);

// SAFETY: the engine only passes it on, on documented threads.
unsafe impl Send for UserData {}
// SAFETY: as above.
unsafe impl Sync for UserData {}

impl UserData {
    fn get(self) -> *mut c_void {
        self.0
    }
}

/// Draws one camera into an image or buffer without a host copy, as ZS_PIXEL_RGBA8, BGRA8 or
/// RGBA_F32. The renderer's device must be adopted.
///
/// Returns when the scene is drawn and the copy is submitted. The copy starts after the waits and
/// ends with the signals; without semaphores, queue order applies. The renderer's next picture may
/// wait for this copy, so no wait may depend on it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_render_to_vulkan(
    renderer: *const zs_renderer,
    camera: *const zs_camera,
    target: *const zs_vulkan_target,
    options: *const zs_render_options,
) -> zs_status {
    guard(|| {
        // SAFETY: the caller's arguments.
        let (renderer, camera, options) =
            unsafe { (borrow(renderer, "renderer")?, read_given(camera)?.camera()?, read_versioned(options)?) };
        if !renderer.adopted {
            return Err(Failure::argument(
                "renderer",
                "one on a device of the engine's",
                "one of zs_device_from_vulkan",
            ));
        }
        let layout = match options.checked()? {
            zs_pixel_format::ZS_PIXEL_RGBA8 => PixelLayout::Rgba8,
            zs_pixel_format::ZS_PIXEL_BGRA8 => PixelLayout::Bgra8,
            zs_pixel_format::ZS_PIXEL_RGBA_F32 => PixelLayout::RgbaF32,
            other => {
                let expected = "RGBA8, BGRA8 or RGBA_F32 for images and buffers of the device";
                return Err(Failure::argument("pixel format", format!("{other:?}"), expected));
            }
        };
        // SAFETY: the caller's arguments.
        let target = unsafe { read_versioned(target)?.target(&camera, layout) }?;
        let options = options.outputs(true, true, false)?;
        Ok(renderer.lock().render_to(&camera, &options, layout, &target)?)
    })
}

impl zs_vulkan_target {
    /// # Safety
    /// The handles meet the documented requirements.
    unsafe fn target(&self, camera: &zipsplat::types::Camera, layout: PixelLayout) -> Result<Target, Failure> {
        let points = |pointer, count: usize, name| {
            // SAFETY: the caller's array.
            let points = unsafe { array::<zs_semaphore_point>(pointer, count, name) }?;
            Ok::<_, Failure>(points.iter().map(|p| Point { semaphore: p.semaphore, value: p.value }).collect())
        };
        if self.reserved != 0 || (self.image == 0) == (self.buffer == 0) {
            let found = if self.reserved != 0 { "a reserved field in use" } else { "both or none" };
            return Err(Failure::argument("zs_vulkan_target", found, "an image or a buffer"));
        }
        let waits = points(self.waits, self.wait_count, "waits")?;
        let signals = points(self.signals, self.signal_count, "signals")?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        if self.image != 0 {
            let place = ImagePlace {
                image: self.image,
                offset: [self.x, self.y],
                extent: [width, height],
                mip_level: self.mip_level,
                array_layer: self.array_layer,
                old_layout: self.old_layout,
                new_layout: if self.new_layout == 0 { SHADER_READ_ONLY } else { self.new_layout },
            };
            // SAFETY: the caller guarantees the handles and the place.
            return Ok(unsafe { Target::image(place, waits, signals) });
        }
        let needed = u64::from(width) * u64::from(height) * layout.bytes() as u64;
        if self.buffer_size < needed || !self.buffer_offset.is_multiple_of(4) {
            let found = format!("{} bytes at {}", self.buffer_size, self.buffer_offset);
            return Err(Failure::argument("buffer", found, format!("{needed} bytes at a multiple of 4")));
        }
        // SAFETY: the caller guarantees the handles; the size was checked.
        Ok(unsafe { Target::buffer(self.buffer, self.buffer_offset, waits, signals) })
    }
}
