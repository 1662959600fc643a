use super::{
    extensions,
    features::{ADDRESSES, BYTES, DOT_PRODUCTS, Features, HALVES, MATRICES, REQUIRED},
    instance::Instance,
    limits::{Limits, Matrices, MatrixShape},
};
use crate::{Error, Result};
use ash::{khr, vk};

/// A Vulkan device of this machine.
#[derive(Clone, Debug, serde::Serialize)]
pub struct DeviceInfo {
    /// Index for `--device`.
    pub index: usize,
    /// Missing requirements; empty if usable.
    pub unusable_reason: Vec<String>,
    /// Name, driver, limits and features.
    pub limits: Limits,
}

impl DeviceInfo {
    /// Digits match an index, other selectors a UUID or part of a name.
    pub(crate) fn is_selected(&self, selector: &str) -> bool {
        let uuid = selector.strip_prefix("GPU-").unwrap_or(selector).replace('-', "");
        match selector {
            _ if uuid.eq_ignore_ascii_case(self.limits.uuid()) => true,
            index if !index.is_empty() && index.bytes().all(|byte| byte.is_ascii_digit()) => {
                index.parse() == Ok(self.index)
            }
            name => self.limits.name.to_lowercase().contains(&name.to_lowercase()),
        }
    }

    pub(crate) fn lacks(&self) -> String {
        format!("{} lacks {}", self.limits.name, self.unusable_reason.join(", "))
    }
}

/// Lists every Vulkan device, usable or not.
///
/// # Errors
/// [`Error::NoDevice`] without a Vulkan loader or driver.
pub fn list_devices() -> Result<Vec<DeviceInfo>> {
    let instance = Instance::new(false)?;
    Ok(devices(&instance)?.into_iter().map(|(_, info)| info).collect())
}

pub(crate) fn devices(instance: &Instance) -> Result<Vec<(vk::PhysicalDevice, DeviceInfo)>> {
    // SAFETY: the instance is alive.
    let physical = unsafe { instance.raw.enumerate_physical_devices() }
        .map_err(|e| Error::NoDevice(format!("vkEnumeratePhysicalDevices: {e}")))?;
    if physical.is_empty() {
        return Err(Error::NoDevice("no Vulkan driver is installed".into()));
    }
    let info = |(index, device): (usize, vk::PhysicalDevice)| {
        let (limits, support) = probe(instance, device);
        (device, DeviceInfo { index, unusable_reason: missing_features(&limits, &support), limits })
    };
    Ok(physical.into_iter().enumerate().map(info).collect())
}

pub(crate) struct Support {
    pub api: u32,
    pub queue_family: Option<u32>,
    pub portability_subset: bool,
    pub features: Features,
    pub subgroups: bool,
    pub subgroup_control: bool,
    pub one_subgroup_size: bool,
    pub llvmpipe_major: Option<u32>,
}

const INTEL: u32 = 0x8086;

pub(crate) fn probe(instance: &Instance, device: vk::PhysicalDevice) -> (Limits, Support) {
    let knows = |minor, patch| instance.validates(vk::make_api_version(0, 1, minor, patch));
    let (validated, entry, instance) = (instance.debug.is_some(), &instance.entry, &instance.raw);
    let mut v11 = vk::PhysicalDeviceVulkan11Properties::default();
    let mut v12 = vk::PhysicalDeviceVulkan12Properties::default();
    let mut v13 = vk::PhysicalDeviceVulkan13Properties::default();
    let mut offered = Features::default();
    let mut properties =
        vk::PhysicalDeviceProperties2::default().push_next(&mut v11).push_next(&mut v12).push_next(&mut v13);
    let mut bf16 = extensions::Bfloat16::default();
    let mut second = extensions::CooperativeMatrix2::default();
    // SAFETY: a plain query on a live instance.
    let extensions = unsafe { instance.enumerate_device_extension_properties(device) }.unwrap_or_default();
    let has = |name| extensions.iter().any(|e| e.extension_name_as_c_str() == Ok(name));
    let mut features = vk::PhysicalDeviceFeatures2::default()
        .push_next(&mut offered.v11)
        .push_next(&mut offered.v12)
        .push_next(&mut offered.v13)
        .push_next(&mut offered.matrix);
    if has(extensions::BFLOAT16) && knows(4, 313) {
        features = features.push_next(&mut bf16);
    }
    if has(extensions::COOPERATIVE_MATRIX2) && knows(4, 304) {
        features = features.push_next(&mut second);
    }
    // SAFETY: plain queries on a live instance; structures unknown to an old device stay zero.
    let (memory, families) = unsafe {
        instance.get_physical_device_properties2(device, &mut properties);
        instance.get_physical_device_features2(device, &mut features);
        (
            instance.get_physical_device_memory_properties(device),
            instance.get_physical_device_queue_family_properties(device),
        )
    };
    offered.v10 = features.features;
    let base = properties.properties;
    let text = |s: Option<&std::ffi::CStr>| s.map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let compute = vk::QueueFlags::COMPUTE;
    let queue_family = families.iter().position(|f| f.queue_flags.contains(compute)).map(|i| i as u32);
    let kind = base.device_type;
    let api = base.api_version;
    let driver_version = text(v12.driver_info_as_c_str().ok());
    let llvmpipe_major = (v12.driver_id == vk::DriverId::MESA_LLVMPIPE)
        .then(|| driver_version.split(' ').nth(1).and_then(|v| v.split('.').next()?.parse().ok()).unwrap_or(0));
    let half_storage = offered.have(&HALVES);
    let matrices = has(khr::cooperative_matrix::NAME)
        && knows(3, 255)
        && half_storage
        && offered.have(&MATRICES)
        // Mesa 26.1's lavapipe crashes on 8 x 8 matrices with subgroups of 16.
        && (v12.driver_id != vk::DriverId::MESA_LLVMPIPE || v11.subgroup_size <= 8);
    let offers = Offers {
        bf16: [bf16.in_buffers, bf16.matrices] == [vk::TRUE; 2],
        i8: offered.have(&BYTES),
        conversions: second.conversions == vk::TRUE,
    };
    let subgroup_control = v13.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE);
    // Intel reports subgroups of 32, its size with the fewest registers per lane; kernels keep
    // tiles in registers.
    let narrowest = base.vendor_id == INTEL && subgroup_control;
    let limits = Limits {
        name: text(base.device_name_as_c_str().ok()),
        driver: format!("{} {driver_version}", text(v12.driver_name_as_c_str().ok())),
        api: format!("{}.{}.{}", vk::api_version_major(api), vk::api_version_minor(api), vk::api_version_patch(api)),
        cpu: kind == vk::PhysicalDeviceType::CPU,
        discrete: kind == vk::PhysicalDeviceType::DISCRETE_GPU,
        integrated: kind == vk::PhysicalDeviceType::INTEGRATED_GPU,
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
        dot_products: half_storage && offered.have(&DOT_PRODUCTS),
        dot_products_accelerated: v13.integer_dot_product4x8_bit_packed_signed_accelerated == vk::TRUE,
        // Mesa 26 is the oldest measured version.
        addresses: llvmpipe_major >= Some(26) && offered.have(&ADDRESSES),
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
    let support = Support {
        api,
        queue_family,
        portability_subset: has(khr::portability_subset::NAME),
        features: offered,
        subgroups,
        one_subgroup_size: v13.min_subgroup_size == v13.max_subgroup_size,
        subgroup_control,
        llvmpipe_major,
    };
    (limits, support)
}

struct Offers {
    bf16: bool,
    i8: bool,
    conversions: bool,
}

/// Finds the largest matrix shape of each type, then the squarest, with the fewest loads per
/// product.
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
                // Kernels load 8 factors at a time.
                && [p.m_size, p.n_size, p.k_size].iter().all(|side| side % 8 == 0)
        };
        let size =
            |p: &&vk::CooperativeMatrixPropertiesKHR<'_>| (p.m_size * p.n_size * p.k_size, p.m_size.min(p.n_size));
        let best = shapes.iter().filter(fits).max_by_key(size)?;
        Some(MatrixShape { m: best.m_size, n: best.n_size, k: best.k_size })
    };
    let (f16, f32, i32) = (Component::FLOAT16, Component::FLOAT32, Component::SINT32);
    Matrices {
        f16: largest(f16, f32),
        f16_sums: largest(f16, f32) == largest(f16, f16),
        bf16: largest(extensions::BFLOAT16_COMPONENT, f32).filter(|_| offers.bf16),
        i8: largest(Component::SINT8, i32).filter(|_| offers.i8),
        conversions: offers.conversions,
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub(crate) fn missing_features(limits: &Limits, support: &Support) -> Vec<String> {
    let mut missing = Vec::new();
    if support.api < vk::API_VERSION_1_3 {
        missing.push(format!("Vulkan 1.3 (has {})", limits.api));
    }
    if support.queue_family.is_none() {
        missing.push("a compute queue".into());
    }
    // Before Mesa 25, lavapipe silently ends loops after 65,535 iterations.
    if let Some(major) = support.llvmpipe_major.filter(|m| *m < 25) {
        missing.push(format!(
            "lavapipe 25 or later (Mesa {major} computes long loops wrongly; the sources' tools/dev/run-on-lavapipe PROGRAM runs \
             a program on a newer one)"
        ));
    }
    let absent = REQUIRED.iter().filter(|feature| !support.features.have(&[**feature]));
    missing.extend(absent.map(|feature| feature.name.to_string_lossy().into_owned()));
    if !support.subgroups {
        missing.push("subgroup arithmetic, ballot and shuffle in compute".into());
    }
    if !(support.subgroup_control || support.one_subgroup_size) {
        missing.push("subgroups of one size".into());
    }
    missing
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_a_device_and_nothing_else() {
        let names = ["NVIDIA H100 80GB HBM3", "NVIDIA GeForce RTX 4090", "llvmpipe"];
        let device = |(index, name): (usize, &&str)| {
            let identity = format!("{index}{}-driver", "0123456789abcdef".repeat(2).split_off(1));
            let limits = Limits { name: name.to_string(), identity, ..Limits::default() };
            DeviceInfo { index, unusable_reason: Vec::new(), limits }
        };
        let devices: Vec<_> = names.iter().enumerate().map(device).collect();
        let selected = |selector: &str| {
            let found = devices.iter().filter(|d| d.is_selected(selector));
            found.map(|d| d.index).collect::<Vec<_>>()
        };
        assert_eq!([selected("0"), selected("1"), selected("2")], [vec![0], vec![1], vec![2]]);
        assert_eq!(
            [selected("3"), selected("4090"), selected("99999999999999999999"), selected("none")],
            [const { Vec::<usize>::new() }; 4]
        );
        assert_eq!([selected("nvidia"), selected("RTX 4090")], [vec![0, 1], vec![1]]);
        assert_eq!(selected("GPU-11234567-89ab-cdef-0123-456789abcdef"), [1]);
        assert_eq!(selected("2123456789ABCDEF0123456789abcdef"), [2]);
    }
}
