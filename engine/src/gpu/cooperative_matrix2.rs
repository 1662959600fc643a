//! VK_NV_cooperative_matrix2, which ash 0.38 does not know: its features, and the matrices of whole workgroups.

use super::{WorkgroupMatrices, limits::MatrixShape};
use ash::vk;
use std::{
    ffi::{CStr, c_void},
    mem, ptr,
};

pub const NAME: &CStr = c"VK_NV_cooperative_matrix2";
const QUERY: &CStr = c"vkGetPhysicalDeviceCooperativeMatrixFlexibleDimensionsPropertiesNV";

/// VkPhysicalDeviceCooperativeMatrix2FeaturesNV.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct Features {
    s_type: vk::StructureType,
    p_next: *mut c_void,
    workgroup_scope: vk::Bool32,
    flexible_dimensions: vk::Bool32,
    reductions: vk::Bool32,
    conversions: vk::Bool32,
    per_element_operations: vk::Bool32,
    tensor_addressing: vk::Bool32,
    block_loads: vk::Bool32,
}

impl Default for Features {
    fn default() -> Self {
        Self {
            s_type: vk::StructureType::from_raw(1000593000),
            p_next: ptr::null_mut(),
            workgroup_scope: vk::FALSE,
            flexible_dimensions: vk::FALSE,
            reductions: vk::FALSE,
            conversions: vk::FALSE,
            per_element_operations: vk::FALSE,
            tensor_addressing: vk::FALSE,
            block_loads: vk::FALSE,
        }
    }
}

impl Features {
    /// What our kernels use.
    pub fn used() -> Self {
        Self {
            workgroup_scope: vk::TRUE,
            flexible_dimensions: vk::TRUE,
            reductions: vk::TRUE,
            conversions: vk::TRUE,
            per_element_operations: vk::TRUE,
            tensor_addressing: vk::TRUE,
            ..Self::default()
        }
    }

    /// Whether the device has that.
    pub fn has_used(&self) -> bool {
        let found = [
            self.workgroup_scope,
            self.flexible_dimensions,
            self.reductions,
            self.conversions,
            self.per_element_operations,
            self.tensor_addressing,
        ];
        found == [vk::TRUE; 6]
    }
}

// SAFETY: laid out as the extension says, with the structure type that it names.
unsafe impl vk::ExtendsPhysicalDeviceFeatures2 for Features {}
// SAFETY: as above.
unsafe impl vk::ExtendsDeviceCreateInfo for Features {}
// SAFETY: as above.
unsafe impl vk::TaggedStructure for Features {
    const STRUCTURE_TYPE: vk::StructureType = vk::StructureType::from_raw(1000593000);
}

/// VkCooperativeMatrixFlexibleDimensionsPropertiesNV.
#[repr(C)]
#[derive(Clone, Copy)]
struct FlexibleDimensions {
    s_type: vk::StructureType,
    p_next: *mut c_void,
    granularity: [u32; 3],
    types: [vk::ComponentTypeKHR; 4],
    saturating: vk::Bool32,
    scope: vk::ScopeKHR,
    invocations: u32,
}

type Query = unsafe extern "system" fn(vk::PhysicalDevice, *mut u32, *mut FlexibleDimensions) -> vk::Result;

/// The matrices of whole workgroups with f16 factors and f32 sums, where those with f16 sums, as which results are stored,
/// have the same sides.
pub fn workgroup_matrices(
    entry: &ash::Entry,
    instance: &ash::Instance,
    device: vk::PhysicalDevice,
) -> Vec<WorkgroupMatrices> {
    // SAFETY: a name, and a live instance.
    let Some(query) = (unsafe { entry.get_instance_proc_addr(instance.handle(), QUERY.as_ptr()) }) else {
        return Vec::new();
    };
    // SAFETY: the function of this name has this type.
    let query: Query = unsafe { mem::transmute(query) };
    let mut count = 0;
    // SAFETY: the device has the extension; without an array only the count is written.
    if unsafe { query(device, &mut count, ptr::null_mut()) } != vk::Result::SUCCESS {
        return Vec::new();
    }
    let empty = FlexibleDimensions {
        s_type: vk::StructureType::from_raw(1000593001),
        p_next: ptr::null_mut(),
        granularity: [0; 3],
        types: [vk::ComponentTypeKHR::FLOAT16; 4],
        saturating: vk::FALSE,
        scope: vk::ScopeKHR::SUBGROUP,
        invocations: 0,
    };
    let mut found = vec![empty; count as usize];
    // SAFETY: room for as many as were counted.
    if unsafe { query(device, &mut count, found.as_mut_ptr()) } != vk::Result::SUCCESS {
        return Vec::new();
    }
    found.truncate(count as usize);
    let with_sums = |sum: vk::ComponentTypeKHR| {
        let half = vk::ComponentTypeKHR::FLOAT16;
        let fits = move |p: &&FlexibleDimensions| {
            p.types == [half, half, sum, sum] && p.scope == vk::ScopeKHR::WORKGROUP && p.saturating == vk::FALSE
        };
        let matrices = |p: &FlexibleDimensions| {
            let [m, n, k] = p.granularity;
            WorkgroupMatrices { invocations: p.invocations, granularity: MatrixShape { m, n, k } }
        };
        found.iter().filter(fits).map(matrices)
    };
    let stored =
        |matrices: &WorkgroupMatrices| with_sums(vk::ComponentTypeKHR::FLOAT16).any(|other| other == *matrices);
    with_sums(vk::ComponentTypeKHR::FLOAT32).filter(stored).collect()
}
