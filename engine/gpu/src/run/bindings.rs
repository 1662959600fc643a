use crate::{
    device::Shared,
    memory::{
        Memory, Resident,
        tensor::{Home, Tensor},
    },
    plan::Plan,
};
use ash::vk;
use std::sync::Arc;

#[derive(Clone, Copy)]
pub(crate) struct BufferRange {
    pub buffer: vk::Buffer,
    pub from: u64,
    pub to: u64,
    /// Device address of the range's start, if [`Limits::addresses`](crate::Limits::addresses).
    pub address: u64,
}

impl BufferRange {
    pub fn descriptor(&self) -> vk::DescriptorBufferInfo {
        vk::DescriptorBufferInfo { buffer: self.buffer, offset: self.from, range: self.to - self.from }
    }

    pub fn overlaps(&self, other: &BufferRange) -> bool {
        self.buffer == other.buffer && self.from < other.to && other.from < self.to
    }
}

pub(crate) struct Bindings<'a> {
    pub shared: &'a Shared,
    pub plan: &'a Plan,
    pub arena: &'a Memory,
    pub residents: &'a [Arc<Resident>],
}

impl Bindings<'_> {
    pub fn range(&self, tensor: Tensor) -> BufferRange {
        let (memory, block, base) = match tensor.home {
            Home::Arena(id) => {
                let place = self.plan.placements[id as usize];
                (self.arena, place.block, place.offset)
            }
            Home::Resident { layout, block } => {
                let resident = self.residents.iter().find(|resident| resident.layout == layout);
                (&resident.expect("a plan runs with the memory that it uses").memory, block, 0)
            }
        };
        // Vulkan rejects empty ranges. Every allocation has at least 16 bytes.
        let bytes = tensor.bytes.next_multiple_of(4).max(16);
        let (buffer, from) = (memory.buffer(block), base + tensor.offset);
        BufferRange { buffer, from, to: from + bytes, address: memory.address(block) + from }
    }
}
