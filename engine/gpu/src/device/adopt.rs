use super::{
    Shared,
    features::{BYTES, DOT_PRODUCTS, Feature, HALVES, MATRICES, REQUIRED},
    instance::Instance,
    limits::Matrices,
    probe::{missing_features, probe},
    queue::{Queue, QueueLock},
};
use crate::{Device, Error, Result};
use ash::vk::{self, Handle};
use std::{
    ffi::{CStr, c_void},
    path::PathBuf,
    sync::Arc,
};

/// Vulkan version, extension or feature that an app must enable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Requirement {
    /// Minimum `VkApplicationInfo::apiVersion`.
    ApiVersion(&'static CStr),
    /// Device extension.
    DeviceExtension(&'static CStr),
    /// Feature and the structure that declares it.
    Feature {
        /// Field.
        name: &'static CStr,
        /// Structure.
        structure: &'static CStr,
    },
}

/// Returns the requirements of every device.
pub fn requirements() -> Vec<Requirement> {
    [Requirement::ApiVersion(c"1.3")].into_iter().chain(REQUIRED.map(feature)).collect()
}

/// Returns the features for matrix units, integer dot products and 16-bit floats.
pub fn fast_requirements() -> Vec<Requirement> {
    let extension = Requirement::DeviceExtension(ash::khr::cooperative_matrix::NAME);
    let features = HALVES.into_iter().chain(MATRICES).chain(BYTES).chain(DOT_PRODUCTS);
    [extension].into_iter().chain(features.map(feature)).collect()
}

fn feature(feature: Feature) -> Requirement {
    Requirement::Feature { name: feature.name, structure: feature.structure }
}

/// An app's Vulkan handles. The engine never destroys them.
pub struct Adopted {
    /// The app's `vkGetInstanceProcAddr`; `None` loads the system's loader.
    pub get_instance_proc_addr: Option<unsafe extern "C" fn()>,
    /// `VkInstance`.
    pub instance: *mut c_void,
    /// `VkPhysicalDevice`.
    pub physical_device: *mut c_void,
    /// `VkDevice`.
    pub device: *mut c_void,
    /// `VkQueue` of `device`.
    pub queue: *mut c_void,
    /// Family of the queue, with compute support.
    pub queue_family: u32,
    /// Serializes use of the queue; `None`: the engine is its only user.
    pub queue_lock: Option<QueueLock>,
    /// Whether every supported feature of [`fast_requirements`] is enabled.
    pub fast: bool,
    /// As [`DeviceOptions::cache_dir`](crate::DeviceOptions::cache_dir).
    pub cache_dir: Option<PathBuf>,
}

impl Device {
    /// Adopts an app's device.
    ///
    /// # Safety
    /// The handles are valid, belong together and outlive the last clone of this device. Everything
    /// in [`requirements`] is enabled, and [`Adopted::fast`] is true to its description.
    ///
    /// # Errors
    /// [`Error::Argument`] for a null handle or a queue without compute, [`Error::NoDevice`] if the
    /// device lacks a requirement.
    pub unsafe fn adopt(adopted: Adopted) -> Result<Self> {
        let handles = [adopted.instance, adopted.physical_device, adopted.device, adopted.queue];
        if handles.iter().any(|handle| handle.is_null()) {
            return Err(Error::argument("Vulkan handles", "a null one", "instance, physical device, device and queue"));
        }
        let [instance, physical, device, queue] = handles.map(|handle| handle as usize as u64);
        let instance = Instance::adopt(adopted.get_instance_proc_addr, vk::Instance::from_raw(instance))?;
        let physical = vk::PhysicalDevice::from_raw(physical);
        let (mut limits, support) = probe(&instance, physical);
        (limits.matrices.bf16, limits.matrices.conversions) = (None, false);
        limits.addresses = false;
        if !adopted.fast {
            (limits.half_storage, limits.matrices, limits.dot_products) = (false, Matrices::default(), false);
        }
        let missing = missing_features(&limits, &support);
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
        let mut shared = Shared::new(instance, physical, raw, queue, family, limits, support.subgroup_control)?;
        shared.cache_dir = adopted.cache_dir;
        Ok(Self(Arc::new(shared)))
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
        let devices = crate::device::probe::devices(&shared.instance).expect("listed before");
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
                cache_dir: None,
            };
            // SAFETY: these handles have everything enabled and outlive the adopted device.
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
