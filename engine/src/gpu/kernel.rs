//! What a compiled kernel is, as build.rs writes it into the typed table.

use super::Tensor;

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
    /// Ids of the specialisation constants.
    pub constant_ids: &'static [u32],
    /// Workgroup size.
    pub local_size: LocalSize,
}

/// One storage buffer of a kernel.
#[derive(Debug)]
pub struct Binding {
    /// Name of the block, in snake case.
    pub name: &'static str,
    /// Binding number in set 0.
    pub binding: u32,
    /// Whether the kernel may read it.
    pub reads: bool,
    /// Whether the kernel may write it.
    pub writes: bool,
}

/// How many invocations a workgroup has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LocalSize {
    /// As the source says.
    Fixed([u32; 3]),
    /// One subgroup, whatever its size on the device (specialisation constant 0).
    Subgroup,
}

/// A call of a kernel: its tensors, push constants and specialisation constants by name.
pub trait Kernel {
    /// Code and interface.
    const MODULE: Module;
    /// The same without the code of any effect: see [`super::Recorder::plain`].
    const PLAIN: Module = Self::MODULE;
    /// Tensors in the order of [`Module::bindings`].
    fn buffers(&self) -> Vec<Tensor>;
    /// Push constants, by word.
    fn push(&self) -> [u32; 16];
    /// Values of [`Module::constant_ids`], as bits.
    fn constants(&self) -> Vec<u32>;
}
