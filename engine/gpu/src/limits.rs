//! What a device is and can do, and what it would need to have.

use super::{Element, bfloat16, instance::Instance};
use crate::{Error, Result};
use ash::{khr, vk};
use std::ffi::CStr;

/// What a device is and can do, as far as plans depend on it.
#[derive(Clone, Debug, serde::Serialize)]
pub struct Limits {
    /// The device's name.
    pub name: String,
    /// The driver's name and version.
    pub driver: String,
    /// Vulkan version, `major.minor.patch`.
    pub api: String,
    /// Whether the device is a CPU.
    pub cpu: bool,
    /// Whether the device is a discrete GPU.
    pub discrete: bool,
    /// Invocations in a subgroup.
    pub subgroup_size: u32,
    /// Bytes that one binding of a kernel may span.
    pub max_binding_bytes: u64,
    /// Bytes that one allocation may have.
    pub max_block_bytes: u64,
    /// Workgroups along x, y, z.
    pub max_groups: [u32; 3],
    /// Bytes of shared memory of a workgroup.
    pub shared_bytes: u32,
    /// Bytes of the memory that kernels work in.
    pub memory_bytes: u64,
    /// Nanoseconds of one timestamp tick.
    pub timestamp_ns: f64,
    /// Bits of a timestamp; 0 where there are no timestamps.
    pub timestamp_bits: u32,
    /// Invocations that a workgroup may have.
    pub max_invocations: u32,
    /// Whether kernels may read and write 16-bit floats.
    pub half_storage: bool,
    /// Matrices that a subgroup multiplies as one (VK_KHR_cooperative_matrix).
    pub matrices: Matrices,
    /// Device, driver and whether validation is on, exactly: what was measured on one is not true of another, and a message
    /// of the layer fails a kernel that computes rightly.
    pub identity: String,
}

/// Sides of the matrices that a subgroup multiplies: `[m, k]` times `[k, n]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct MatrixShape {
    /// Rows of the product.
    pub m: u32,
    /// Columns of the product.
    pub n: u32,
    /// Terms of a sum.
    pub k: u32,
}

/// The matrices that a subgroup multiplies as one, by the type of their factors.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Matrices {
    /// f16 factors, f32 sums.
    pub f16: Option<MatrixShape>,
    /// bf16 factors, f32 sums (VK_KHR_shader_bfloat16).
    pub bf16: Option<MatrixShape>,
    /// Signed 8-bit factors, 32-bit sums.
    pub i8: Option<MatrixShape>,
}

impl Matrices {
    /// Those with factors of this type.
    pub fn of(&self, factor: Element) -> Option<MatrixShape> {
        match factor {
            Element::F32 => None,
            Element::F16 => self.f16,
            Element::Bf16 => self.bf16,
            Element::I8 => self.i8,
        }
    }
}

impl Limits {
    /// Refuses to measure on a device without timestamps.
    ///
    /// # Errors
    /// [`Error::NoDevice`].
    pub fn check_timestamps(&self) -> Result<()> {
        match self.timestamp_bits {
            0 => Err(Error::NoDevice(format!("{} has no timestamps, which measuring needs", self.name))),
            _ => Ok(()),
        }
    }
}

impl Default for Limits {
    /// A plain desktop device, for plans made without one.
    fn default() -> Self {
        Self {
            name: "none".into(),
            driver: String::new(),
            api: "1.3.0".into(),
            cpu: false,
            discrete: true,
            subgroup_size: 32,
            max_binding_bytes: u32::MAX as u64,
            max_block_bytes: 4 << 30,
            max_groups: [65535; 3],
            shared_bytes: 32 << 10,
            memory_bytes: u64::MAX,
            timestamp_ns: 1.0,
            timestamp_bits: 64,
            max_invocations: 1024,
            half_storage: true,
            matrices: Matrices {
                f16: Some(MatrixShape { m: 16, n: 16, k: 16 }),
                bf16: Some(MatrixShape { m: 16, n: 16, k: 16 }),
                i8: Some(MatrixShape { m: 16, n: 16, k: 32 }),
            },
            identity: "none".into(),
        }
    }
}

const FEATURES_12: &CStr = c"VkPhysicalDeviceVulkan12Features";
const FEATURES_13: &CStr = c"VkPhysicalDeviceVulkan13Features";

/// Features that a device needs, each with the structure it is a field of.
pub(super) const REQUIRED_FEATURES: [(&CStr, &CStr); 6] = [
    (c"timelineSemaphore", FEATURES_12),
    (c"scalarBlockLayout", FEATURES_12),
    (c"synchronization2", FEATURES_13),
    (c"maintenance4", FEATURES_13),
    (c"subgroupSizeControl", FEATURES_13),
    (c"computeFullSubgroups", FEATURES_13),
];

const FEATURES_11: &CStr = c"VkPhysicalDeviceVulkan11Features";
const FEATURES_MATRIX: &CStr = c"VkPhysicalDeviceCooperativeMatrixFeaturesKHR";

/// Features that matrix units and 16-bit floats need.
pub(super) const FAST_FEATURES: [(&CStr, &CStr); 6] = [
    (c"storageBuffer16BitAccess", FEATURES_11),
    (c"shaderFloat16", FEATURES_12),
    (c"shaderInt8", FEATURES_12),
    (c"vulkanMemoryModel", FEATURES_12),
    (c"vulkanMemoryModelDeviceScope", FEATURES_12),
    (c"cooperativeMatrix", FEATURES_MATRIX),
];

/// Properties that decide whether a device can be used, beside [`Limits`].
pub(super) struct Found {
    pub api: u32,
    pub queue_family: Option<u32>,
    pub portability_subset: bool,
    pub features: Vec<(&'static str, bool)>,
    pub subgroup_control: bool,
    pub llvmpipe_major: Option<u32>,
}

/// Its number among PCI vendors.
const INTEL: u32 = 0x8086;

/// Reads what a device is and can do.
pub(super) fn probe(instance: &Instance, device: vk::PhysicalDevice) -> (Limits, Found) {
    let knows = |minor, patch| instance.validates(vk::make_api_version(0, 1, minor, patch));
    let (validated, entry, instance) = (instance.debug.is_some(), &instance.entry, &instance.raw);
    let mut v11 = vk::PhysicalDeviceVulkan11Properties::default();
    let mut v12 = vk::PhysicalDeviceVulkan12Properties::default();
    let mut v13 = vk::PhysicalDeviceVulkan13Properties::default();
    let mut f11 = vk::PhysicalDeviceVulkan11Features::default();
    let mut f12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut f13 = vk::PhysicalDeviceVulkan13Features::default();
    let mut properties =
        vk::PhysicalDeviceProperties2::default().push_next(&mut v11).push_next(&mut v12).push_next(&mut v13);
    let mut cooperative = vk::PhysicalDeviceCooperativeMatrixFeaturesKHR::default();
    let mut bf16 = bfloat16::Features::default();
    // SAFETY: a plain query on a live instance.
    let extensions = unsafe { instance.enumerate_device_extension_properties(device) }.unwrap_or_default();
    let has = |name| extensions.iter().any(|e| e.extension_name_as_c_str() == Ok(name));
    let mut features = vk::PhysicalDeviceFeatures2::default()
        .push_next(&mut f11)
        .push_next(&mut f12)
        .push_next(&mut f13)
        .push_next(&mut cooperative);
    if has(bfloat16::NAME) && knows(4, 313) {
        features = features.push_next(&mut bf16);
    }
    // SAFETY: plain queries on a live instance; structures that an old device does not know stay zero.
    let (memory, families) = unsafe {
        instance.get_physical_device_properties2(device, &mut properties);
        instance.get_physical_device_features2(device, &mut features);
        (
            instance.get_physical_device_memory_properties(device),
            instance.get_physical_device_queue_family_properties(device),
        )
    };
    let base = properties.properties;
    let text = |s: Option<&std::ffi::CStr>| s.map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let compute = vk::QueueFlags::COMPUTE;
    let queue_family = families.iter().position(|f| f.queue_flags.contains(compute)).map(|i| i as u32);
    let kind = base.device_type;
    let api = base.api_version;
    let driver_version = text(v12.driver_info_as_c_str().ok());
    let half_storage = f11.storage_buffer16_bit_access == vk::TRUE;
    let matrices = has(khr::cooperative_matrix::NAME)
        && knows(3, 255)
        && cooperative.cooperative_matrix == vk::TRUE
        && half_storage
        && f12.shader_float16 == vk::TRUE
        && f12.vulkan_memory_model == vk::TRUE
        && f12.vulkan_memory_model_device_scope == vk::TRUE
        // Mesa 26.1's lavapipe crashes where it compiles its matrices of 8 x 8 for subgroups of 16.
        && (v12.driver_id != vk::DriverId::MESA_LLVMPIPE || v11.subgroup_size <= 8);
    let offers = Offers { bf16: bf16.has_matrices(), i8: f12.shader_int8 == vk::TRUE };
    let subgroup_control = v13.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE);
    // Intel's drivers name 32, of the sizes that there are the one that leaves a lane the fewest registers: 32 of 4 bytes on
    // most of their GPUs. The kernels keep tiles in registers.
    let narrowest = base.vendor_id == INTEL && subgroup_control;
    let limits = Limits {
        name: text(base.device_name_as_c_str().ok()),
        driver: format!("{} {driver_version}", text(v12.driver_name_as_c_str().ok())),
        api: format!("{}.{}.{}", vk::api_version_major(api), vk::api_version_minor(api), vk::api_version_patch(api)),
        cpu: kind == vk::PhysicalDeviceType::CPU,
        discrete: kind == vk::PhysicalDeviceType::DISCRETE_GPU,
        subgroup_size: if narrowest { v13.min_subgroup_size } else { v11.subgroup_size },
        max_binding_bytes: base.limits.max_storage_buffer_range as u64,
        max_block_bytes: v11.max_memory_allocation_size.min(v13.max_buffer_size).min(4 << 30),
        max_groups: base.limits.max_compute_work_group_count,
        shared_bytes: base.limits.max_compute_shared_memory_size,
        memory_bytes: memory
            .memory_heaps_as_slice()
            .iter()
            .filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL))
            .map(|h| h.size)
            .max()
            .unwrap_or(0),
        timestamp_ns: base.limits.timestamp_period as f64,
        timestamp_bits: queue_family.map_or(0, |f| families[f as usize].timestamp_valid_bits),
        max_invocations: base.limits.max_compute_work_group_invocations.min(base.limits.max_compute_work_group_size[0]),
        half_storage,
        matrices: if matrices { find_matrices(entry, instance, device, &offers) } else { Matrices::default() },
        identity: format!(
            "{}-{}-{:x}{}",
            hex(&v11.device_uuid),
            hex(&v11.driver_uuid),
            base.driver_version,
            if validated { "-validated" } else { "" }
        ),
    };
    let operations = vk::SubgroupFeatureFlags::BASIC
        | vk::SubgroupFeatureFlags::VOTE
        | vk::SubgroupFeatureFlags::ARITHMETIC
        | vk::SubgroupFeatureFlags::BALLOT
        | vk::SubgroupFeatureFlags::SHUFFLE;
    let subgroups = v11.subgroup_supported_operations.contains(operations)
        && v11.subgroup_supported_stages.contains(vk::ShaderStageFlags::COMPUTE);
    let offered = [
        f12.timeline_semaphore,
        f12.scalar_block_layout,
        f13.synchronization2,
        f13.maintenance4,
        f13.subgroup_size_control,
        f13.compute_full_subgroups,
    ];
    let mut offered = offered.into_iter();
    let required =
        REQUIRED_FEATURES.map(|(name, _)| (name.to_str().unwrap_or_default(), offered.next() == Some(vk::TRUE)));
    let found = Found {
        api,
        queue_family,
        portability_subset: has(khr::portability_subset::NAME),
        features: required
            .into_iter()
            .chain([("subgroup arithmetic, ballot and shuffle in compute", subgroups)])
            .chain([("subgroups of one size", subgroup_control || v13.min_subgroup_size == v13.max_subgroup_size)])
            .collect(),
        subgroup_control,
        llvmpipe_major: (v12.driver_id == vk::DriverId::MESA_LLVMPIPE)
            .then(|| driver_version.split(' ').nth(1).and_then(|v| v.split('.').next()?.parse().ok()).unwrap_or(0)),
    };
    (limits, found)
}

/// Optional parts of matrices that are not in the list of their shapes.
struct Offers {
    bf16: bool,
    i8: bool,
}

/// The largest matrices of each kind that a subgroup multiplies; of two as large, the squarer ones, whose rows and columns
/// are loaded least often for what they give.
fn find_matrices(
    entry: &ash::Entry,
    instance: &ash::Instance,
    device: vk::PhysicalDevice,
    offers: &Offers,
) -> Matrices {
    use vk::ComponentTypeKHR as Component;
    let loader = khr::cooperative_matrix::Instance::new(entry, instance);
    // SAFETY: a plain query; the device has the extension.
    let shapes = unsafe { loader.get_physical_device_cooperative_matrix_properties(device) }.unwrap_or_default();
    let largest = |factor: Component, sum: Component| {
        let fits = |p: &&vk::CooperativeMatrixPropertiesKHR<'_>| {
            [p.a_type, p.b_type] == [factor; 2]
                && [p.c_type, p.result_type] == [sum; 2]
                && p.scope == vk::ScopeKHR::SUBGROUP
                && p.saturating_accumulation == vk::FALSE
                // Kernels move 8 factors at a time.
                && [p.m_size, p.n_size, p.k_size].iter().all(|side| side % 8 == 0)
        };
        let size =
            |p: &&vk::CooperativeMatrixPropertiesKHR<'_>| (p.m_size * p.n_size * p.k_size, p.m_size.min(p.n_size));
        let best = shapes.iter().filter(fits).max_by_key(size)?;
        Some(MatrixShape { m: best.m_size, n: best.n_size, k: best.k_size })
    };
    let (f32, i32) = (Component::FLOAT32, Component::SINT32);
    Matrices {
        f16: largest(Component::FLOAT16, f32),
        bf16: largest(bfloat16::COMPONENT_TYPE, f32).filter(|_| offers.bf16),
        i8: largest(Component::SINT8, i32).filter(|_| offers.i8),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// What a device would need to have and has not.
pub(super) fn missing_features(limits: &Limits, found: &Found) -> Vec<String> {
    let mut missing = Vec::new();
    if found.api < vk::API_VERSION_1_3 {
        missing.push(format!("Vulkan 1.3 (has {})", limits.api));
    }
    if found.queue_family.is_none() {
        missing.push("a compute queue".into());
    }
    // Mesa 22's lavapipe cuts loops off after 65,535 iterations without a word.
    if let Some(major) = found.llvmpipe_major.filter(|m| *m < 25) {
        missing.push(format!("lavapipe 25 or later (Mesa {major} computes long loops wrongly)"));
    }
    missing.extend(found.features.iter().filter(|f| !f.1).map(|f| f.0.to_owned()));
    missing
}
