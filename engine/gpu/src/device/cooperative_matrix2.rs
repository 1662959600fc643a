//! VK_NV_cooperative_matrix2, missing from ash 0.38. Only conversions are used.

use ash::vk;
use std::{
    ffi::{CStr, c_void},
    ptr,
};

pub const NAME: &CStr = c"VK_NV_cooperative_matrix2";

const TYPE: vk::StructureType = vk::StructureType::from_raw(1000593000);

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

impl Features {
    pub fn conversions() -> Self {
        Self { conversions: vk::TRUE, ..Self::default() }
    }

    pub fn has_conversions(&self) -> bool {
        self.conversions == vk::TRUE
    }
}

impl Default for Features {
    fn default() -> Self {
        Self {
            s_type: TYPE,
            p_next: ptr::null_mut(),
            workgroup_scope: 0,
            flexible_dimensions: 0,
            reductions: 0,
            conversions: 0,
            per_element_operations: 0,
            tensor_addressing: 0,
            block_loads: 0,
        }
    }
}

// SAFETY: as the extension specifies.
unsafe impl vk::ExtendsPhysicalDeviceFeatures2 for Features {}
// SAFETY: as above.
unsafe impl vk::ExtendsDeviceCreateInfo for Features {}
// SAFETY: as above.
unsafe impl vk::TaggedStructure for Features {
    const STRUCTURE_TYPE: vk::StructureType = TYPE;
}
