//! VK_KHR_shader_bfloat16, missing from ash 0.38.

use ash::vk;
use std::{
    ffi::{CStr, c_void},
    ptr,
};

pub const NAME: &CStr = c"VK_KHR_shader_bfloat16";

pub const COMPONENT_TYPE: vk::ComponentTypeKHR = vk::ComponentTypeKHR::from_raw(1000141000);

#[repr(C)]
#[derive(Clone, Copy)]
pub struct Features {
    s_type: vk::StructureType,
    p_next: *mut c_void,
    in_buffers: vk::Bool32,
    dot_product: vk::Bool32,
    matrices: vk::Bool32,
}

impl Features {
    pub fn matrices() -> Self {
        Self { in_buffers: vk::TRUE, matrices: vk::TRUE, ..Self::default() }
    }

    pub fn has_matrices(&self) -> bool {
        [self.in_buffers, self.matrices] == [vk::TRUE; 2]
    }
}

impl Default for Features {
    fn default() -> Self {
        let s_type = vk::StructureType::from_raw(1000141000);
        Self { s_type, p_next: ptr::null_mut(), in_buffers: 0, dot_product: 0, matrices: 0 }
    }
}

// SAFETY: as the extension specifies.
unsafe impl vk::ExtendsPhysicalDeviceFeatures2 for Features {}
// SAFETY: as above.
unsafe impl vk::ExtendsDeviceCreateInfo for Features {}
// SAFETY: as above.
unsafe impl vk::TaggedStructure for Features {
    const STRUCTURE_TYPE: vk::StructureType = vk::StructureType::from_raw(1000141000);
}
