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
    Camera,
    gpu::{Adopted, Device, ImagePlace, Point, QueueLock, Requirement, Target, fast_requirements, requirements},
    stages::render::PixelLayout,
};

#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum zs_requirement_kind {
    ZS_REQUIRES_API_VERSION = 0,
    ZS_REQUIRES_DEVICE_EXTENSION = 1,
    ZS_REQUIRES_FEATURE = 2,
}

pub(super) type zs_requirement_kind_value = i32;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_vulkan_requirement {
    pub kind: zs_requirement_kind_value,
    pub optional: u32,
    pub name: *const c_char,
    pub structure: *const c_char,
}

pub type zs_vulkan_function = Option<unsafe extern "C" fn()>;

pub type zs_queue_lock = Option<unsafe extern "C" fn(user_data: *mut c_void)>;

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_vulkan_device {
    pub struct_size: u32,
    pub queue_family: u32,
    pub get_instance_proc_addr: zs_vulkan_function,
    pub instance: *mut c_void,
    pub physical_device: *mut c_void,
    pub device: *mut c_void,
    pub queue: *mut c_void,
    pub lock_queue: zs_queue_lock,
    pub unlock_queue: zs_queue_lock,
    pub user_data: *mut c_void,
    pub optional_features_enabled: u32,
    pub reserved: u32,
    pub cache_dir: *const c_char,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_semaphore_point {
    pub semaphore: u64,
    pub value: u64,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub struct zs_vulkan_target {
    pub struct_size: u32,
    pub reserved: u32,
    pub image: u64,
    pub x: u32,
    pub y: u32,
    pub mip_level: u32,
    pub array_layer: u32,
    pub old_layout: i32,
    pub new_layout: i32,
    pub buffer: u64,
    pub buffer_offset: u64,
    pub buffer_size: u64,
    pub wait_count: usize,
    pub signal_count: usize,
    pub waits: *const zs_semaphore_point,
    pub signals: *const zs_semaphore_point,
}

versioned!(zs_vulkan_device { reserved }, zs_vulkan_target { reserved });

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

#[unsafe(no_mangle)]
pub unsafe extern "C" fn zs_device_from_vulkan(
    vulkan: *const zs_vulkan_device,
    device: *mut *mut zs_device,
) -> zs_status {
    let adopt = || {
        // SAFETY: the caller's structure.
        let given = unsafe { read_versioned(vulkan) }?;
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
            unsafe { (borrow(renderer, "renderer")?, Camera::from(&read_given(camera)?), read_versioned(options)?) };
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
    unsafe fn target(&self, camera: &Camera, layout: PixelLayout) -> Result<Target, Failure> {
        let points = |pointer, count: usize, name| {
            // SAFETY: the caller's array.
            let points = unsafe { array::<zs_semaphore_point>(pointer, count, name) }?;
            Ok::<_, Failure>(points.iter().map(|p| Point { semaphore: p.semaphore, value: p.value }).collect())
        };
        if (self.image == 0) == (self.buffer == 0) {
            return Err(Failure::argument("zs_vulkan_target", "both or none", "an image or a buffer"));
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
