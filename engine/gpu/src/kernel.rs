//! What a compiled kernel is, as build.rs writes it into the typed table.

use super::Tensor;
use half::{bf16, f16};
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
    /// Ids of the specialisation constants.
    pub constant_ids: &'static [u32],
    /// Workgroup size.
    pub local_size: LocalSize,
    /// What the device must have beside the basics.
    pub needs: Needs,
}

impl Hash for Module {
    /// Of its code.
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.spirv.hash(state);
    }
}

/// What a kernel asks of a device beside the basics.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// 16-bit floats in buffers.
    pub half_storage: bool,
    /// Matrices that a subgroup multiplies (VK_KHR_cooperative_matrix), with factors of this type.
    pub matrices: Option<Element>,
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

/// The type of values that a kernel takes in several types (`#pragma element` and `#pragma factor` in its source).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Element {
    /// IEEE single precision.
    #[default]
    F32,
    /// IEEE half precision: 11 bits, up to 65504.
    F16,
    /// The upper half of a single precision number: 8 bits and its range.
    Bf16,
    /// Whole numbers from -127 to 127, with a scale elsewhere. Only as factors of matrix units.
    I8,
}

impl Element {
    /// Types of 16 bits.
    pub const HALVES: [Self; 2] = [Self::F16, Self::Bf16];
    /// Types of factors that matrix units multiply.
    pub const FACTORS: [Self; 3] = [Self::F16, Self::Bf16, Self::I8];

    /// As in the names of kernels.
    pub fn name(self) -> &'static str {
        match self {
            Element::F32 => "f32",
            Element::F16 => "f16",
            Element::Bf16 => "bf16",
            Element::I8 => "i8",
        }
    }

    /// Bytes of one value.
    pub fn bytes(self) -> usize {
        match self {
            Element::F32 => 4,
            Element::F16 | Element::Bf16 => 2,
            Element::I8 => 1,
        }
    }

    /// The largest value.
    pub fn largest(self) -> f32 {
        match self {
            Element::F32 => f32::MAX,
            Element::F16 => 65504.0,
            Element::Bf16 => f32::from_bits(0x7f7f_0000),
            Element::I8 => 127.0,
        }
    }

    /// The most by which rounding to nearest moves a number, relative to it; of whole numbers, relative to the largest.
    pub fn roundoff(self) -> f64 {
        match self {
            Element::F32 => (-24f64).exp2(),
            Element::F16 => (-11f64).exp2(),
            Element::Bf16 => (-8f64).exp2(),
            Element::I8 => 0.5 / 127.0,
        }
    }

    /// The bytes of numbers in this type, rounded to nearest; what it cannot hold saturates.
    pub fn encode(self, values: &[f32]) -> Vec<u8> {
        let held = values.iter().map(|x| x.clamp(-self.largest(), self.largest()));
        match self {
            Element::F32 => bytemuck::cast_slice(values).to_vec(),
            Element::F16 => held.flat_map(|x| f16::from_f32(x).to_ne_bytes()).collect(),
            Element::Bf16 => held.flat_map(|x| bf16::from_f32(x).to_ne_bytes()).collect(),
            Element::I8 => held.map(|x| x.round_ties_even() as i8 as u8).collect(),
        }
    }

    /// The numbers that bytes of this type hold.
    pub fn decode(self, bytes: &[u8]) -> Vec<f32> {
        let halves = || bytes.as_chunks::<2>().0.iter().copied();
        match self {
            Element::F32 => bytes.as_chunks::<4>().0.iter().copied().map(f32::from_ne_bytes).collect(),
            Element::F16 => halves().map(|x| f16::from_ne_bytes(x).to_f32()).collect(),
            Element::Bf16 => halves().map(|x| bf16::from_ne_bytes(x).to_f32()).collect(),
            Element::I8 => bytes.iter().map(|x| f32::from(*x as i8)).collect(),
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
