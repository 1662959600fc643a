use crate::{Element, Tensor};
use std::hash::{Hash, Hasher};

/// A kernel's code and interface.
#[derive(Debug)]
pub struct Module {
    /// Path below `kernels/`, such as `render/project`.
    pub name: &'static str,
    /// SPIR-V, little endian.
    pub spirv: &'static [u8],
    /// Storage buffers by binding number.
    pub bindings: &'static [Binding],
    /// Bytes of push constants.
    pub push_bytes: u32,
    /// Buffers also passed by address: index in `bindings` and first word of push constants. Needs
    /// [`addresses`](crate::Limits::addresses).
    pub addresses: &'static [(usize, u32)],
    /// Specialization constant IDs.
    pub constant_ids: &'static [u32],
    /// Workgroup size.
    pub local_size: LocalSize,
    /// Needed device features.
    pub needs: Needs,
}

impl Hash for Module {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.spirv.hash(state);
    }
}

/// Optional device features that a kernel needs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// 16-bit floats in buffers.
    pub half_storage: bool,
    /// Factor type of cooperative matrices.
    pub matrices: Option<Element>,
    /// Conversions of cooperative matrices.
    pub conversions: bool,
    /// Dot products of four signed 8-bit integers.
    pub dot_products: bool,
}

/// A kernel's storage buffer.
#[derive(Debug)]
pub struct Binding {
    /// Block name in snake case.
    pub name: &'static str,
    /// Binding number in set 0.
    pub binding: u32,
    /// Whether the kernel may read the buffer.
    pub reads: bool,
    /// Whether the kernel may write the buffer.
    pub writes: bool,
}

/// Invocations of a workgroup.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LocalSize {
    /// Fixed by the source.
    Fixed([u32; 3]),
    /// One subgroup of the device's size (specialization constant 0).
    Subgroup,
    /// Subgroup count at this index of [`Module::constant_ids`].
    Subgroups(usize),
}

impl LocalSize {
    pub(crate) fn xyz(self, subgroup: u32, constants: &[u32]) -> [u32; 3] {
        match self {
            LocalSize::Fixed(size) => size,
            LocalSize::Subgroup => [subgroup, 1, 1],
            LocalSize::Subgroups(index) => [constants[index] * subgroup, 1, 1],
        }
    }
}

/// A kernel call.
pub trait Kernel {
    /// Returns the module for this call's element types.
    fn module(&self) -> &'static Module;
    /// Returns the tensors in the order of [`Module::bindings`].
    fn buffers(&self) -> Vec<Tensor>;
    /// Returns the push constants.
    fn push(&self) -> [u32; 16];
    /// Returns the bits of [`Module::constant_ids`].
    fn constants(&self) -> Vec<u32>;
}
