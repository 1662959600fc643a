use ash::vk;
use std::ffi::CStr;

#[derive(Clone, Copy, Default)]
pub(crate) struct Features {
    pub v10: vk::PhysicalDeviceFeatures,
    pub v11: vk::PhysicalDeviceVulkan11Features<'static>,
    pub v12: vk::PhysicalDeviceVulkan12Features<'static>,
    pub v13: vk::PhysicalDeviceVulkan13Features<'static>,
    pub matrix: vk::PhysicalDeviceCooperativeMatrixFeaturesKHR<'static>,
}

#[derive(Clone, Copy)]
pub(crate) struct Feature {
    pub name: &'static CStr,
    pub structure: &'static CStr,
    field: fn(&mut Features) -> &mut vk::Bool32,
}

pub(crate) const REQUIRED: [Feature; 6] = [
    Feature { name: c"timelineSemaphore", structure: V12, field: |f| &mut f.v12.timeline_semaphore },
    Feature { name: c"scalarBlockLayout", structure: V12, field: |f| &mut f.v12.scalar_block_layout },
    Feature { name: c"synchronization2", structure: V13, field: |f| &mut f.v13.synchronization2 },
    Feature { name: c"maintenance4", structure: V13, field: |f| &mut f.v13.maintenance4 },
    Feature { name: c"subgroupSizeControl", structure: V13, field: |f| &mut f.v13.subgroup_size_control },
    Feature { name: c"computeFullSubgroups", structure: V13, field: |f| &mut f.v13.compute_full_subgroups },
];

pub(crate) const HALVES: [Feature; 1] =
    [Feature { name: c"storageBuffer16BitAccess", structure: V11, field: |f| &mut f.v11.storage_buffer16_bit_access }];

/// `vulkanMemoryModelDeviceScope`: without it, the memory model restricts every kernel's atomics to
/// workgroups.
pub(crate) const MATRICES: [Feature; 4] = [
    Feature { name: c"shaderFloat16", structure: V12, field: |f| &mut f.v12.shader_float16 },
    Feature { name: c"vulkanMemoryModel", structure: V12, field: |f| &mut f.v12.vulkan_memory_model },
    Feature {
        name: c"vulkanMemoryModelDeviceScope",
        structure: V12,
        field: |f| &mut f.v12.vulkan_memory_model_device_scope,
    },
    Feature { name: c"cooperativeMatrix", structure: MATRIX, field: |f| &mut f.matrix.cooperative_matrix },
];

pub(crate) const ADDRESSES: [Feature; 2] = [
    Feature { name: c"shaderInt64", structure: V10, field: |f| &mut f.v10.shader_int64 },
    Feature { name: c"bufferDeviceAddress", structure: V12, field: |f| &mut f.v12.buffer_device_address },
];

pub(crate) const BYTES: [Feature; 1] =
    [Feature { name: c"shaderInt8", structure: V12, field: |f| &mut f.v12.shader_int8 }];

pub(crate) const DOT_PRODUCTS: [Feature; 1] =
    [Feature { name: c"shaderIntegerDotProduct", structure: V13, field: |f| &mut f.v13.shader_integer_dot_product }];

const V10: &CStr = c"VkPhysicalDeviceFeatures";
const V11: &CStr = c"VkPhysicalDeviceVulkan11Features";
const V12: &CStr = c"VkPhysicalDeviceVulkan12Features";
const V13: &CStr = c"VkPhysicalDeviceVulkan13Features";
const MATRIX: &CStr = c"VkPhysicalDeviceCooperativeMatrixFeaturesKHR";

impl Features {
    pub fn have(&self, features: &[Feature]) -> bool {
        let mut copy = *self;
        features.iter().all(|feature| *(feature.field)(&mut copy) == vk::TRUE)
    }

    pub fn enable(&mut self, features: &[Feature]) {
        for feature in features {
            *(feature.field)(self) = vk::TRUE;
        }
    }
}
