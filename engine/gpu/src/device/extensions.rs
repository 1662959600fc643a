//! Extensions that ash 0.38 lacks.

use ash::vk;
use std::{
    ffi::{CStr, c_void},
    ptr,
};

macro_rules! features {
    ($name:ident, $number:literal, $($feature:ident),+) => {
        #[repr(C)]
        #[derive(Clone, Copy)]
        pub struct $name {
            pub s_type: vk::StructureType,
            pub p_next: *mut c_void,
            $(pub $feature: vk::Bool32,)+
        }

        impl Default for $name {
            fn default() -> Self {
                let s_type = <Self as vk::TaggedStructure>::STRUCTURE_TYPE;
                Self { s_type, p_next: ptr::null_mut(), $($feature: vk::FALSE,)+ }
            }
        }

        // SAFETY: as the extension specifies.
        unsafe impl vk::ExtendsPhysicalDeviceFeatures2 for $name {}
        // SAFETY: as above.
        unsafe impl vk::ExtendsDeviceCreateInfo for $name {}
        // SAFETY: as above.
        unsafe impl vk::TaggedStructure for $name {
            const STRUCTURE_TYPE: vk::StructureType = vk::StructureType::from_raw($number);
        }
    };
}

pub const BFLOAT16: &CStr = c"VK_KHR_shader_bfloat16";
pub const BFLOAT16_COMPONENT: vk::ComponentTypeKHR = vk::ComponentTypeKHR::from_raw(1000141000);
features!(Bfloat16, 1000141000, in_buffers, dot_product, matrices);

/// Only conversions are used.
pub const COOPERATIVE_MATRIX2: &CStr = c"VK_NV_cooperative_matrix2";
features!(
    CooperativeMatrix2,
    1000593000,
    workgroup_scope,
    flexible_dimensions,
    reductions,
    conversions,
    per_element_operations,
    tensor_addressing,
    block_loads
);
