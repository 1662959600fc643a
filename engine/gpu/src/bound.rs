use super::{
    device::Shared,
    memory::{Memory, Resident},
    plan::Plan,
    tensor::{Home, Tensor},
};
use ash::vk;
use std::sync::Arc;

#[derive(Clone, Copy)]
pub(super) struct Range {
    pub buffer: vk::Buffer,
    pub from: u64,
    pub to: u64,
    /// Device address of the range's start, if [`Limits::addresses`](super::Limits::addresses).
    pub address: u64,
}

impl Range {
    pub fn descriptor(&self) -> vk::DescriptorBufferInfo {
        vk::DescriptorBufferInfo { buffer: self.buffer, offset: self.from, range: self.to - self.from }
    }

    pub fn meets(&self, other: &Range) -> bool {
        self.buffer == other.buffer && self.from < other.to && other.from < self.to
    }
}

pub(super) struct Bound<'a> {
    pub shared: &'a Shared,
    pub plan: &'a Plan,
    pub arena: &'a Memory,
    pub residents: &'a [Arc<Resident>],
}

impl Bound<'_> {
    pub fn range(&self, tensor: Tensor) -> Range {
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
        Range { buffer, from, to: from + bytes, address: memory.address(block) + from }
    }
}
