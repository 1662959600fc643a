//! The features of Vulkan that the engine uses: a table of those that it needs, and of those that make it fast.

use ash::vk;
use std::ffi::CStr;

/// The features that a device offers, or those that are enabled on it.
#[derive(Clone, Copy, Default)]
pub(super) struct Features {
    pub v10: vk::PhysicalDeviceFeatures,
    pub v11: vk::PhysicalDeviceVulkan11Features<'static>,
    pub v12: vk::PhysicalDeviceVulkan12Features<'static>,
    pub v13: vk::PhysicalDeviceVulkan13Features<'static>,
    pub matrix: vk::PhysicalDeviceCooperativeMatrixFeaturesKHR<'static>,
}

/// A feature, and the structure that it is a field of.
#[derive(Clone, Copy)]
pub(super) struct Feature {
    pub name: &'static CStr,
    pub structure: &'static CStr,
    field: fn(&mut Features) -> &mut vk::Bool32,
}

/// Features that every device needs.
pub(super) const REQUIRED: [Feature; 6] = [
    Feature { name: c"timelineSemaphore", structure: V12, field: |f| &mut f.v12.timeline_semaphore },
    Feature { name: c"scalarBlockLayout", structure: V12, field: |f| &mut f.v12.scalar_block_layout },
    Feature { name: c"synchronization2", structure: V13, field: |f| &mut f.v13.synchronization2 },
    Feature { name: c"maintenance4", structure: V13, field: |f| &mut f.v13.maintenance4 },
    Feature { name: c"subgroupSizeControl", structure: V13, field: |f| &mut f.v13.subgroup_size_control },
    Feature { name: c"computeFullSubgroups", structure: V13, field: |f| &mut f.v13.compute_full_subgroups },
];

/// The feature that 16-bit floats in buffers need.
pub(super) const HALVES: [Feature; 1] =
    [Feature { name: c"storageBuffer16BitAccess", structure: V11, field: |f| &mut f.v11.storage_buffer16_bit_access }];

/// Features that matrix units need. Without the last of the memory model atomics would be restricted to workgroups, also in
/// kernels without that model.
pub(super) const MATRICES: [Feature; 4] = [
    Feature { name: c"shaderFloat16", structure: V12, field: |f| &mut f.v12.shader_float16 },
    Feature { name: c"vulkanMemoryModel", structure: V12, field: |f| &mut f.v12.vulkan_memory_model },
    Feature {
        name: c"vulkanMemoryModelDeviceScope",
        structure: V12,
        field: |f| &mut f.v12.vulkan_memory_model_device_scope,
    },
    Feature { name: c"cooperativeMatrix", structure: MATRIX, field: |f| &mut f.matrix.cooperative_matrix },
];

/// Features that kernels need which read buffers by their address.
pub(super) const ADDRESSES: [Feature; 2] = [
    Feature { name: c"shaderInt64", structure: V10, field: |f| &mut f.v10.shader_int64 },
    Feature { name: c"bufferDeviceAddress", structure: V12, field: |f| &mut f.v12.buffer_device_address },
];

/// The feature that matrices of 8-bit numbers need beside those.
pub(super) const BYTES: [Feature; 1] =
    [Feature { name: c"shaderInt8", structure: V12, field: |f| &mut f.v12.shader_int8 }];

/// The feature that dot products of 8-bit numbers on lanes need.
pub(super) const DOT_PRODUCTS: [Feature; 1] =
    [Feature { name: c"shaderIntegerDotProduct", structure: V13, field: |f| &mut f.v13.shader_integer_dot_product }];

const V10: &CStr = c"VkPhysicalDeviceFeatures";
const V11: &CStr = c"VkPhysicalDeviceVulkan11Features";
const V12: &CStr = c"VkPhysicalDeviceVulkan12Features";
const V13: &CStr = c"VkPhysicalDeviceVulkan13Features";
const MATRIX: &CStr = c"VkPhysicalDeviceCooperativeMatrixFeaturesKHR";

impl Features {
    /// True where all of `features` are there.
    pub fn have(&self, features: &[Feature]) -> bool {
        let mut copy = *self;
        features.iter().all(|feature| *(feature.field)(&mut copy) == vk::TRUE)
    }

    /// Asks for all of them.
    pub fn enable(&mut self, features: &[Feature]) {
        for feature in features {
            *(feature.field)(self) = vk::TRUE;
        }
    }
}
