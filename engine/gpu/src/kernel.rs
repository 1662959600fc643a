//! Compiled kernels, as build.rs writes them into the typed table.

use super::{element::Element, tensor::Tensor};
use std::hash::{Hash, Hasher};

/// A kernel's code and interface.
#[derive(Debug)]
pub struct Module {
    /// Path below `kernels/`, for example `render/project`: also its debug label and its row in a profile.
    pub name: &'static str,
    /// SPIR-V, little endian.
    pub spirv: &'static [u8],
    /// Storage buffers in the order of their binding numbers.
    pub bindings: &'static [Binding],
    /// Bytes of push constants.
    pub push_bytes: u32,
    /// Buffers, by place in `bindings`, whose address the kernel gets beside them, and the push constants' word from which on; only
    /// for devices with [`addresses`](super::Limits::addresses).
    pub addresses: &'static [(usize, u32)],
    /// Ids of the specialisation constants.
    pub constant_ids: &'static [u32],
    /// Workgroup size.
    pub local_size: LocalSize,
    /// The features that the device must have beside the basics.
    pub needs: Needs,
}

impl Hash for Module {
    /// Hashes the kernel's code.
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.spirv.hash(state);
    }
}

/// The features that a kernel asks of a device beside the basics.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// 16-bit floats in buffers.
    pub half_storage: bool,
    /// Matrices that a subgroup multiplies (VK_KHR_cooperative_matrix), with factors of this type.
    pub matrices: Option<Element>,
    /// Dot products of four signed 8-bit integers.
    pub dot_products: bool,
}

/// One storage buffer of a kernel.
#[derive(Debug)]
pub struct Binding {
    /// Name of the block, in snake case.
    pub name: &'static str,
    /// Binding number in set 0.
    pub binding: u32,
    /// The kernel may read the buffer.
    pub reads: bool,
    /// The kernel may write the buffer.
    pub writes: bool,
}

/// How many invocations a workgroup has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LocalSize {
    /// As the source says.
    Fixed([u32; 3]),
    /// One subgroup, whatever its size on the device (specialisation constant 0).
    Subgroup,
    /// As many subgroups as the constant at this index of [`Module::constant_ids`] says.
    Subgroups(usize),
}

impl LocalSize {
    /// Invocations along x, y and z on a device whose subgroups have `subgroup` of them.
    pub(super) fn xyz(self, subgroup: u32, constants: &[u32]) -> [u32; 3] {
        match self {
            LocalSize::Fixed(size) => size,
            LocalSize::Subgroup => [subgroup, 1, 1],
            LocalSize::Subgroups(index) => [constants[index] * subgroup, 1, 1],
        }
    }
}

/// A call of a kernel: its tensors, push constants and specialisation constants by name.
pub trait Kernel {
    /// Code and interface, for the element types of this call.
    fn module(&self) -> &'static Module;
    /// Tensors in the order of [`Module::bindings`].
    fn buffers(&self) -> Vec<Tensor>;
    /// Push constants, by word.
    fn push(&self) -> [u32; 16];
    /// Values of [`Module::constant_ids`], as bits.
    fn constants(&self) -> Vec<u32>;
}
