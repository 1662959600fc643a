//! Devices of an app: what it must have enabled, and its handles taken over without owning them.

use super::{
    Device,
    device::{Shared, SharedParts},
    features::{BYTES, DOT_PRODUCTS, Feature, HALVES, MATRICES, REQUIRED},
    instance::Instance,
    limits::Matrices,
    probe::{missing_features, probe},
    queue::Queue,
};
use crate::{Error, Result};
use ash::vk::{self, Handle};
use std::{
    ffi::{CStr, c_void},
    sync::Arc,
};

pub use super::queue::QueueLock;

/// Something that an app has to enable on its own instance or device before the engine can use that.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Requirement {
    /// `VkApplicationInfo::apiVersion`, at least.
    ApiVersion(&'static CStr),
    /// An extension of the device.
    DeviceExtension(&'static CStr),
    /// A feature, and the structure that it is a field of.
    Feature {
        /// The field.
        name: &'static CStr,
        /// The structure.
        structure: &'static CStr,
    },
}

/// Everything that has to be enabled.
pub fn requirements() -> Vec<Requirement> {
    [Requirement::ApiVersion(c"1.3")].into_iter().chain(REQUIRED.map(feature)).collect()
}

/// The features that matrix units, dot products of integers and 16-bit floats need, for precisions other than exact. Nothing else is used.
pub fn fast_requirements() -> Vec<Requirement> {
    let extension = Requirement::DeviceExtension(ash::khr::cooperative_matrix::NAME);
    let features = HALVES.into_iter().chain(MATRICES).chain(BYTES).chain(DOT_PRODUCTS);
    [extension].into_iter().chain(features.map(feature)).collect()
}

fn feature(feature: Feature) -> Requirement {
    Requirement::Feature { name: feature.name, structure: feature.structure }
}

/// An app's Vulkan handles. They are used, never destroyed.
pub struct Adopted {
    /// `vkGetInstanceProcAddr` that the app calls; `None` takes the system's loader.
    pub get_instance_proc_addr: Option<unsafe extern "C" fn()>,
    /// `VkInstance`.
    pub instance: *mut c_void,
    /// `VkPhysicalDevice`.
    pub physical_device: *mut c_void,
    /// `VkDevice`.
    pub device: *mut c_void,
    /// `VkQueue` of that device.
    pub queue: *mut c_void,
    /// Family of the queue; it must be able to compute.
    pub queue_family: u32,
    /// How the app's use of the queue and the engine's keep out of each other's way; `None` where only the engine uses it.
    pub queue_lock: Option<QueueLock>,
    /// Whether everything in [`fast_requirements`] is enabled that the physical device has.
    pub fast: bool,
}

impl Device {
    /// Works on an app's device.
    ///
    /// # Safety
    /// The handles are valid and belong together, everything in [`requirements`] is enabled on them and what [`Adopted::fast`]
    /// says, and they stay valid until the last user of this device is gone.
    ///
    /// # Errors
    /// [`Error::NoDevice`] where the physical device or the queue cannot do what the kernels need.
    pub unsafe fn adopt(adopted: Adopted) -> Result<Self> {
        let handles = [adopted.instance, adopted.physical_device, adopted.device, adopted.queue];
        if handles.iter().any(|handle| handle.is_null()) {
            return Err(Error::argument("Vulkan handles", "a null one", "instance, physical device, device and queue"));
        }
        let [instance, physical, device, queue] = handles.map(|handle| handle as usize as u64);
        let instance = Instance::adopt(adopted.get_instance_proc_addr, vk::Instance::from_raw(instance))?;
        let physical = vk::PhysicalDevice::from_raw(physical);
        let (mut limits, found) = probe(&instance, physical);
        // What the app did not have to enable.
        limits.matrices.bf16 = None;
        limits.addresses = false;
        if !adopted.fast {
            (limits.half_storage, limits.matrices, limits.dot_products) = (false, Matrices::default(), false);
        }
        let missing = missing_features(&limits, &found);
        if !missing.is_empty() {
            return Err(Error::NoDevice(format!("{} lacks {}", limits.name, missing.join(", "))));
        }
        let family = adopted.queue_family;
        // SAFETY: the caller vouches for the physical device.
        let families = unsafe { instance.raw.get_physical_device_queue_family_properties(physical) };
        if !families.get(family as usize).is_some_and(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE)) {
            return Err(Error::argument("queue family", family, "one that can compute"));
        }
        limits.timestamp_bits = families[family as usize].timestamp_valid_bits;
        // SAFETY: the caller vouches for the device.
        let raw = unsafe { ash::Device::load(instance.raw.fp_v1_0(), vk::Device::from_raw(device)) };
        let queue = Queue::new(vk::Queue::from_raw(queue), adopted.queue_lock);
        let parts = SharedParts {
            instance,
            physical,
            index: 0,
            raw,
            owned: false,
            queue,
            family,
            limits,
            staged: false,
            passed_over: Vec::new(),
        };
        Shared::new(parts, found.subgroup_control).map(|shared| Self(Arc::new(shared)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DeviceOptions;

    #[test]
    fn a_device_of_an_app_is_as_fast_as_the_app_says() {
        let own = Device::open(&DeviceOptions::default()).expect("a device");
        let shared = &own.0;
        let devices = crate::probe::devices(&shared.instance).expect("listed before");
        let mut found = devices.iter().filter(|(_, info)| info.limits.identity == own.limits().identity);
        let (physical, _) = found.next().expect("it was opened");
        // SAFETY: the device has this queue.
        let queue = unsafe { shared.raw.get_device_queue(shared.family, 0) };
        let pointer = |handle: u64| handle as usize as *mut c_void;
        let adopt = |fast| {
            let adopted = Adopted {
                get_instance_proc_addr: None,
                instance: pointer(shared.instance.raw.handle().as_raw()),
                physical_device: pointer(physical.as_raw()),
                device: pointer(shared.raw.handle().as_raw()),
                queue: pointer(queue.as_raw()),
                queue_family: shared.family,
                queue_lock: None,
                fast,
            };
            // SAFETY: handles of a device that has everything enabled and outlives this one.
            unsafe { Device::adopt(adopted) }.expect("a device that works")
        };
        let (fast, exact) = (adopt(true), adopt(false));
        assert_eq!(exact.limits().matrices, Matrices::default());
        assert!(!exact.limits().half_storage);
        let matrices = fast.limits().matrices;
        assert_eq!((matrices.f16, matrices.i8), (own.limits().matrices.f16, own.limits().matrices.i8));
        drop((fast, exact));
        shared.check_messages().expect("no message of the layer");
    }
}
