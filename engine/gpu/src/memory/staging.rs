//! Staging buffers of a plan's inputs and outputs, unless memory is host visible.

use super::{Memory, copy::record_copies};
use crate::{
    Device, Plan, Result,
    plan::{Allocation, Role, layout::ALIGNMENT},
};
use ash::vk;

pub(crate) struct StagingBuffers {
    memory: Memory,
    offsets: Vec<Option<u64>>,
    pub upload: vk::CommandBuffer,
    pub download: vk::CommandBuffer,
}

impl StagingBuffers {
    pub fn new(
        device: &Device,
        plan: &Plan,
        arena: &Memory,
        [upload, download]: [vk::CommandBuffer; 2],
    ) -> Result<Self> {
        let mut bytes = 0;
        let offset = |allocation: &Allocation| {
            (allocation.role == Role::Input || allocation.output).then(|| {
                let offset = bytes;
                bytes += allocation.bytes.next_multiple_of(ALIGNMENT);
                offset
            })
        };
        let offsets: Vec<Option<u64>> = plan.allocations.iter().map(offset).collect();
        let memory = Memory::host_visible(device, "inputs and outputs", bytes.max(ALIGNMENT))?;
        let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
        for ((allocation, place), offset) in plan.allocations.iter().zip(&plan.placements).zip(&offsets) {
            let Some(offset) = *offset else { continue };
            let size = allocation.bytes.next_multiple_of(4);
            let (staged, own) = (memory.buffer(0), arena.buffer(place.block));
            if allocation.role == Role::Input && size > 0 {
                inputs.push((staged, own, vk::BufferCopy { src_offset: offset, dst_offset: place.offset, size }));
            }
            if allocation.output && size > 0 {
                outputs.push((own, staged, vk::BufferCopy { src_offset: place.offset, dst_offset: offset, size }));
            }
        }
        record_copies(&device.0, upload, &inputs)?;
        record_copies(&device.0, download, &outputs)?;
        Ok(Self { memory, offsets, upload, download })
    }

    /// Returns the memory and offset of an allocation's staging buffer, if any.
    pub fn place(&self, allocation: usize) -> Option<(&Memory, u64)> {
        self.offsets[allocation].map(|offset| (&self.memory, offset))
    }
}
