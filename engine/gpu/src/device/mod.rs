mod adopt;
pub(crate) mod barrier;
mod cache;
mod extensions;
pub(crate) mod failure;
mod features;
mod instance;
mod limits;
mod pipelines;
mod probe;
mod queue;

pub use adopt::{Adopted, Requirement, fast_requirements, requirements};
pub use cache::cache_dir;
pub use limits::{Limits, Matrices, MatrixShape};
pub use probe::{DeviceInfo, list_devices};
pub use queue::QueueLock;

use self::{
    features::{ADDRESSES, BYTES, DOT_PRODUCTS, Features, HALVES, MATRICES, REQUIRED},
    instance::Instance,
    pipelines::Pipelines,
    probe::{devices, probe},
    queue::Queue,
};
use crate::{Error, Result, lock::lock};
use ash::{ext, khr, vk};
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, MutexGuard,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

/// Options of [`Device::open`].
#[derive(Clone, Debug)]
pub struct DeviceOptions {
    /// Index in [`crate::list_devices`], part of a name, or UUID; `None`: the best.
    pub device: Option<String>,
    /// Enables the Khronos layer with synchronization validation: any message fails the run. Fills
    /// scratch tensors with NaN.
    pub validation: bool,
    /// Limit on bytes per binding, to emulate a smaller device.
    pub max_binding_bytes: Option<u64>,
    /// Budget of device memory in bytes.
    pub max_memory_bytes: Option<u64>,
    /// Folder of self-test results and kernel timings, if kept.
    pub cache_dir: Option<PathBuf>,
    /// Kernels read bound buffers only, never device addresses.
    pub robust_access: bool,
    /// Uses staging buffers even for host-visible memory, to emulate a discrete GPU.
    pub force_staging: bool,
}

impl Default for DeviceOptions {
    /// `ZIPSPLAT_VALIDATION=1` enables validation, `ZIPSPLAT_BOUND=1` robust access.
    fn default() -> Self {
        let is_set = |name| std::env::var(name).is_ok_and(|v| v == "1");
        let (validation, robust_access) = (is_set("ZIPSPLAT_VALIDATION"), is_set("ZIPSPLAT_BOUND"));
        Self {
            device: None,
            validation,
            max_binding_bytes: None,
            max_memory_bytes: None,
            cache_dir: cache_dir(),
            robust_access,
            force_staging: false,
        }
    }
}

/// An open device, shared by its clones.
#[derive(Clone)]
pub struct Device(pub(crate) Arc<Shared>);

pub(crate) struct Shared {
    pub raw: ash::Device,
    pub queue: Queue,
    pub family: u32,
    pub limits: Limits,
    pub allocated: AtomicU64,
    pub flops_per_ms: Mutex<HashMap<String, u64>>,
    pub force_staging: bool,
    cache_dir: Option<PathBuf>,
    index: usize,
    passed_over: Vec<String>,
    pub lost: AtomicBool,
    pub pipelines: Pipelines,
    allocator: Mutex<Option<Allocator>>,
    pub instance: Instance,
}

impl Device {
    /// Opens the best device.
    pub fn open_default() -> Result<Self> {
        Self::open(&DeviceOptions::default())
    }

    /// Opens a device.
    ///
    /// # Errors
    /// [`Error::NoDevice`] without a driver or a matching, usable device.
    pub fn open(options: &DeviceOptions) -> Result<Self> {
        let instance = Instance::new(options.validation)?;
        let devices = devices(&instance)?;
        let names = || devices.iter().map(|(_, d)| format!("{}: {}", d.index, d.limits.name)).collect::<Vec<_>>();
        let matching: Vec<_> = devices
            .iter()
            .filter(|(_, d)| options.device.as_ref().is_none_or(|selector| d.is_selected(selector)))
            .collect();
        if matching.is_empty() {
            let selector = options.device.clone().unwrap_or_default();
            return Err(Error::NoDevice(format!(
                "none is '{selector}': digits are an index; those of this machine: {}",
                names().join(", ")
            )));
        }
        let Some((physical, chosen)) = matching
            .iter()
            .filter(|(_, d)| d.unusable_reason.is_empty())
            .min_by_key(|(_, d)| (d.limits.cpu, !d.limits.discrete, d.index))
        else {
            let why: Vec<_> = matching.iter().map(|(_, d)| d.lacks()).collect();
            return Err(Error::NoDevice(why.join("; ")));
        };
        let (physical, index) = (*physical, chosen.index);
        let passed_over =
            matching.iter().filter(|(_, d)| chosen.limits.cpu && !d.limits.cpu).map(|(_, d)| d.lacks()).collect();
        let mut shared = Shared::open(instance, physical, options)?;
        (shared.index, shared.passed_over) = (index, passed_over);
        Ok(Self(Arc::new(shared)))
    }

    /// Returns [`DeviceOptions::device`]'s index; 0 for adopted devices.
    pub fn index(&self) -> usize {
        self.0.index
    }

    /// Returns rejected GPUs with reasons, after a fallback to a CPU.
    pub fn passed_over(&self) -> &[String] {
        &self.0.passed_over
    }

    /// Returns [`DeviceOptions::cache_dir`].
    pub fn cache_dir(&self) -> Option<&Path> {
        self.0.cache_dir.as_deref()
    }

    /// Returns the bytes of device memory in use.
    pub fn allocated_bytes(&self) -> u64 {
        self.0.allocated.load(Ordering::Relaxed)
    }

    /// Fails if the device is lost.
    pub fn check_lost(&self) -> Result<()> {
        self.0.check_lost()
    }

    /// Returns the limits and features.
    pub fn limits(&self) -> &Limits {
        &self.0.limits
    }
}

impl Shared {
    fn open(instance: Instance, physical: vk::PhysicalDevice, options: &DeviceOptions) -> Result<Self> {
        let (mut limits, support) = probe(&instance, physical);
        limits.max_binding_bytes = limits.max_binding_bytes.min(options.max_binding_bytes.unwrap_or(u64::MAX));
        limits.addresses &= !options.robust_access;
        limits.memory_bytes = limits.memory_bytes.min(options.max_memory_bytes.unwrap_or(u64::MAX));
        let family = support.queue_family.ok_or_else(|| Error::NoDevice("no compute queue".into()))?;
        let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(family).queue_priorities(&[1.0])];
        let mut extensions = Vec::new();
        if support.portability_subset {
            extensions.push(khr::portability_subset::NAME.as_ptr());
        }
        let matrices = limits.matrices != Matrices::default();
        let (bf16, i8) = (limits.matrices.bf16.is_some(), limits.matrices.i8.is_some());
        let mut enabled = Features::default();
        enabled.enable(&REQUIRED);
        if limits.half_storage {
            enabled.enable(&HALVES);
        }
        if limits.dot_products {
            enabled.enable(&DOT_PRODUCTS);
        }
        if limits.addresses {
            enabled.enable(&ADDRESSES);
        }
        if matrices {
            extensions.push(khr::cooperative_matrix::NAME.as_ptr());
            enabled.enable(&MATRICES);
        }
        if i8 {
            enabled.enable(&BYTES);
        }
        let mut bf16_features = extensions::Bfloat16 { in_buffers: vk::TRUE, matrices: vk::TRUE, ..Default::default() };
        if bf16 {
            extensions.push(extensions::BFLOAT16.as_ptr());
        }
        let mut conversions = extensions::CooperativeMatrix2 { conversions: vk::TRUE, ..Default::default() };
        if limits.matrices.conversions {
            extensions.push(extensions::COOPERATIVE_MATRIX2.as_ptr());
        }
        let mut info = vk::DeviceCreateInfo::default()
            .queue_create_infos(&queues)
            .enabled_extension_names(&extensions)
            .enabled_features(&enabled.v10)
            .push_next(&mut enabled.v11)
            .push_next(&mut enabled.v12)
            .push_next(&mut enabled.v13);
        if matrices {
            info = info.push_next(&mut enabled.matrix);
        }
        if bf16 {
            info = info.push_next(&mut bf16_features);
        }
        if limits.matrices.conversions {
            info = info.push_next(&mut conversions);
        }
        // SAFETY: `physical` belongs to the instance and supports the features and extensions.
        let raw = unsafe { instance.raw.create_device(physical, &info, None) }
            .map_err(|e| Error::NoDevice(format!("{}: vkCreateDevice: {e}", limits.name)))?;
        // SAFETY: the queue was requested above.
        let queue = Queue::new(unsafe { raw.get_device_queue(family, 0) }, None);
        let mut shared = Self::new(instance, physical, raw, queue, family, limits, support.subgroup_control)?;
        shared.force_staging = options.force_staging;
        shared.cache_dir.clone_from(&options.cache_dir);
        Ok(shared)
    }

    /// Owned as its instance is.
    fn new(
        instance: Instance,
        physical: vk::PhysicalDevice,
        raw: ash::Device,
        queue: Queue,
        family: u32,
        limits: Limits,
        subgroup_control: bool,
    ) -> Result<Self> {
        let debug = instance.debug.as_ref().map(|_| ext::debug_utils::Device::new(&instance.raw, &raw));
        let shared = Self {
            queue,
            family,
            allocated: AtomicU64::new(0),
            flops_per_ms: Mutex::default(),
            force_staging: false,
            cache_dir: None,
            index: 0,
            passed_over: Vec::new(),
            lost: AtomicBool::new(false),
            pipelines: Pipelines::new(raw.clone(), debug, limits.subgroup_size, subgroup_control),
            allocator: Mutex::default(),
            raw,
            limits,
            instance,
        };
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: shared.instance.raw.clone(),
            device: shared.raw.clone(),
            physical_device: physical,
            debug_settings: Default::default(),
            buffer_device_address: shared.limits.addresses,
            allocation_sizes: Default::default(),
        });
        let failed = |e| Error::Driver { call: "gpu_allocator::Allocator::new", result: format!("{e}") };
        *lock(&shared.allocator) = Some(allocator.map_err(failed)?);
        Ok(shared)
    }

    pub fn allocator(&self) -> AllocatorGuard<'_> {
        AllocatorGuard(lock(&self.allocator))
    }

    pub fn check_messages(&self) -> Result<()> {
        if self.instance.debug.is_some() {
            // The layer reports shader errors on completion.
            self.queue.wait_idle(&self.raw).map_err(|e| self.failed("vkQueueWaitIdle", e))?;
        }
        let messages = std::mem::take(&mut *lock(&self.instance.messages));
        if messages.is_empty() {
            return Ok(());
        }
        Err(Error::Driver { call: "validation", result: messages.join("\n") })
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        // SAFETY: the last user waited for all submissions, so nothing else holds these handles.
        unsafe {
            self.pipelines.destroy();
            drop(lock(&self.allocator).take());
            if self.instance.owned {
                self.raw.destroy_device(None);
            }
        }
    }
}

pub(crate) struct AllocatorGuard<'a>(MutexGuard<'a, Option<Allocator>>);

impl std::ops::Deref for AllocatorGuard<'_> {
    type Target = Allocator;
    fn deref(&self) -> &Allocator {
        self.0.as_ref().expect("taken only when the device is dropped")
    }
}

impl std::ops::DerefMut for AllocatorGuard<'_> {
    fn deref_mut(&mut self) -> &mut Allocator {
        self.0.as_mut().expect("taken only when the device is dropped")
    }
}
