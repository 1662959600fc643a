//! Encoding commands, with the barriers that their reads and writes call for.

use super::{
    descriptors::Descriptors,
    device::Shared,
    lost::is_under_way,
    memory::{Memory, Resident},
    plan::{Command, Dispatch, Groups, Home, Operation, Plan, Tensor},
    schedule::Piece,
};
use crate::{Error, Result};
use ash::vk;
use std::sync::Arc;

/// Access of everything that a plan does on the device.
const WRITES: vk::AccessFlags2 = vk::AccessFlags2::from_raw(
    vk::AccessFlags2::SHADER_STORAGE_WRITE.as_raw() | vk::AccessFlags2::TRANSFER_WRITE.as_raw(),
);
const READS: vk::AccessFlags2 = vk::AccessFlags2::from_raw(
    vk::AccessFlags2::SHADER_STORAGE_READ.as_raw()
        | vk::AccessFlags2::TRANSFER_READ.as_raw()
        | vk::AccessFlags2::INDIRECT_COMMAND_READ.as_raw(),
);
const STAGES: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::from_raw(
    vk::PipelineStageFlags2::COMPUTE_SHADER.as_raw()
        | vk::PipelineStageFlags2::TRANSFER.as_raw()
        | vk::PipelineStageFlags2::DRAW_INDIRECT.as_raw(),
);

/// A range of a buffer.
#[derive(Clone, Copy)]
pub(super) struct Range {
    buffer: vk::Buffer,
    from: u64,
    to: u64,
}

impl Range {
    pub fn descriptor(&self) -> vk::DescriptorBufferInfo {
        vk::DescriptorBufferInfo { buffer: self.buffer, offset: self.from, range: self.to - self.from }
    }

    fn meets(&self, other: &Range) -> bool {
        self.buffer == other.buffer && self.from < other.to && other.from < self.to
    }
}

/// Where a plan's tensors are while it runs.
pub(super) struct Bound<'a> {
    pub shared: &'a Shared,
    pub plan: &'a Plan,
    pub arena: &'a Memory,
    pub residents: &'a [Arc<Resident>],
}

impl Bound<'_> {
    pub fn range(&self, tensor: Tensor) -> Range {
        let (buffer, base) = match tensor.home {
            Home::Arena(id) => {
                let place = self.plan.placements[id as usize];
                (self.arena.buffer(place.block), place.offset)
            }
            Home::Resident { layout, block } => {
                let resident = self.residents.iter().find(|resident| resident.layout == layout);
                (resident.expect("a plan runs with the memory that it uses").memory.buffer(block), 0)
            }
        };
        // Vulkan knows no empty ranges; every allocation has room for these 16 bytes.
        let bytes = tensor.bytes.next_multiple_of(4).max(16);
        Range { buffer, from: base + tensor.offset, to: base + tensor.offset + bytes }
    }
}

/// Encodes pieces into one command buffer.
pub(super) struct Encoder<'a> {
    bound: &'a Bound<'a>,
    descriptors: &'a Descriptors,
    commands: vk::CommandBuffer,
    reads: Vec<Range>,
    writes: Vec<Range>,
    /// Timestamps around each piece, for profiles.
    queries: Option<vk::QueryPool>,
    next_query: u32,
}

impl<'a> Encoder<'a> {
    /// Starts recording; earlier submissions' writes are made visible.
    pub fn begin(
        bound: &'a Bound<'a>,
        descriptors: &'a Descriptors,
        commands: vk::CommandBuffer,
        queries: Option<(vk::QueryPool, u32)>,
    ) -> Result<Self> {
        let raw = &bound.shared.raw;
        // SAFETY: the command buffer is not in use.
        unsafe { raw.begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default()) }
            .map_err(|e| driver("vkBeginCommandBuffer", e))?;
        if let Some((pool, count)) = queries {
            // SAFETY: recording; the pool has `count` queries.
            unsafe { raw.cmd_reset_query_pool(commands, pool, 0, count) };
        }
        let encoder = Self {
            bound,
            descriptors,
            commands,
            reads: Vec::new(),
            writes: Vec::new(),
            queries: queries.map(|q| q.0),
            next_query: 0,
        };
        encoder.barrier(vk::PipelineStageFlags2::ALL_COMMANDS, STAGES, READS | WRITES);
        Ok(encoder)
    }

    pub fn piece(&mut self, piece: Piece) -> Result<()> {
        let command = &self.bound.plan.commands[piece.command];
        self.synchronise(command);
        self.timestamp();
        match &command.operation {
            Operation::Dispatch(dispatch) => self.dispatch(dispatch, piece)?,
            Operation::Fill { target, value } => {
                let (range, bytes) = (self.bound.range(*target), target.bytes.next_multiple_of(4));
                // SAFETY: recording; the range is inside its buffer.
                unsafe { self.raw().cmd_fill_buffer(self.commands, range.buffer, range.from, bytes, *value) };
            }
            Operation::Copy { source, target } => {
                let (from, to) = (self.bound.range(*source), self.bound.range(*target));
                let region = vk::BufferCopy { src_offset: from.from, dst_offset: to.from, size: source.bytes };
                // SAFETY: recording; both ranges are inside their buffers and live tensors never overlap.
                unsafe { self.raw().cmd_copy_buffer(self.commands, from.buffer, to.buffer, &[region]) };
            }
        }
        self.timestamp();
        Ok(())
    }

    /// Ends recording; results are made visible to the host.
    pub fn end(self) -> Result<()> {
        self.barrier(STAGES, vk::PipelineStageFlags2::HOST, vk::AccessFlags2::HOST_READ);
        // SAFETY: recording.
        unsafe { self.raw().end_command_buffer(self.commands) }.map_err(|e| driver("vkEndCommandBuffer", e))
    }

    fn raw(&self) -> &ash::Device {
        &self.bound.shared.raw
    }

    /// A barrier where the command reads what was written, or writes what was touched, since the last one.
    fn synchronise(&mut self, command: &Command) {
        let (mut reads, mut writes) = (Vec::new(), Vec::new());
        command.operation.for_each_access(|tensor, read, write| {
            let range = self.bound.range(tensor);
            if read {
                reads.push(range);
            }
            if write {
                writes.push(range);
            }
        });
        let meets = |a: &[Range], b: &[Range]| a.iter().any(|x| b.iter().any(|y| x.meets(y)));
        let hazard = meets(&reads, &self.writes) || meets(&writes, &self.writes) || meets(&writes, &self.reads);
        if hazard || self.queries.is_some() {
            self.barrier(STAGES, STAGES, READS | WRITES);
            self.reads.clear();
            self.writes.clear();
        }
        self.reads.append(&mut reads);
        self.writes.append(&mut writes);
    }

    fn barrier(&self, from: vk::PipelineStageFlags2, to: vk::PipelineStageFlags2, access: vk::AccessFlags2) {
        memory_barrier(self.raw(), self.commands, from, to, access);
    }

    fn timestamp(&mut self) {
        if let Some(pool) = self.queries {
            let stage = vk::PipelineStageFlags2::ALL_COMMANDS;
            // SAFETY: recording; the caller keeps pieces within the pool.
            unsafe { self.raw().cmd_write_timestamp2(self.commands, stage, pool, self.next_query) };
            self.next_query += 1;
        }
    }

    fn dispatch(&self, dispatch: &Dispatch, piece: Piece) -> Result<()> {
        let module = dispatch.module;
        let pipeline = self.bound.shared.pipeline(module, &dispatch.constants)?;
        let sets = [self.descriptors.of(piece.command)];
        let compute = vk::PipelineBindPoint::COMPUTE;
        let push: &[u8] = &bytemuck::bytes_of(&dispatch.push)[..module.push_bytes as usize];
        let (raw, commands) = (self.raw(), self.commands);
        // SAFETY: recording; all handles are alive, and the sets are of the pipeline's layout.
        unsafe {
            raw.cmd_bind_pipeline(commands, compute, pipeline.raw);
            raw.cmd_bind_descriptor_sets(commands, compute, pipeline.layout, 0, &sets, &[]);
            if !push.is_empty() {
                raw.cmd_push_constants(commands, pipeline.layout, vk::ShaderStageFlags::COMPUTE, 0, push);
            }
            match dispatch.groups {
                Groups::Fixed(_) => {
                    let ([x, y, z], [w, h, d]) = (piece.base, piece.groups);
                    raw.cmd_dispatch_base(commands, x, y, z, w, h, d);
                }
                Groups::Indirect(args) => {
                    let range = self.bound.range(args);
                    raw.cmd_dispatch_indirect(commands, range.buffer, range.from);
                }
            }
        }
        Ok(())
    }
}

/// Makes writes before it visible to `access` behind it.
fn memory_barrier(
    raw: &ash::Device,
    commands: vk::CommandBuffer,
    from: vk::PipelineStageFlags2,
    to: vk::PipelineStageFlags2,
    access: vk::AccessFlags2,
) {
    let barrier = [vk::MemoryBarrier2::default()
        .src_stage_mask(from)
        .src_access_mask(WRITES)
        .dst_stage_mask(to)
        .dst_access_mask(access)];
    let info = vk::DependencyInfo::default().memory_barriers(&barrier);
    // SAFETY: the callers are recording into `commands`.
    unsafe { raw.cmd_pipeline_barrier2(commands, &info) };
}

/// Records copies `(from, to, region)`, behind everything that was submitted before, for the device and the host to see.
pub(super) fn record_copies(
    shared: &Shared,
    commands: vk::CommandBuffer,
    copies: &[(vk::Buffer, vk::Buffer, vk::BufferCopy)],
) -> Result<()> {
    let raw = &shared.raw;
    // SAFETY: the command buffer is not in use.
    unsafe { raw.begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default()) }
        .map_err(|e| driver("vkBeginCommandBuffer", e))?;
    let access = vk::AccessFlags2::TRANSFER_READ | vk::AccessFlags2::TRANSFER_WRITE;
    let (all, transfer) = (vk::PipelineStageFlags2::ALL_COMMANDS, vk::PipelineStageFlags2::TRANSFER);
    memory_barrier(raw, commands, all, transfer, access);
    for (from, to, region) in copies {
        // SAFETY: recording; regions are inside their buffers.
        unsafe { raw.cmd_copy_buffer(commands, *from, *to, &[*region]) };
    }
    memory_barrier(raw, commands, STAGES, vk::PipelineStageFlags2::HOST, vk::AccessFlags2::HOST_READ);
    // SAFETY: recording.
    unsafe { raw.end_command_buffer(commands) }.map_err(|e| driver("vkEndCommandBuffer", e))
}

/// Copies between two buffers, behind everything that was submitted before, and waits for it.
pub(super) fn copy_now(shared: &Shared, from: vk::Buffer, to: vk::Buffer, region: vk::BufferCopy) -> Result<()> {
    shared.check_lost()?;
    let raw = &shared.raw;
    let transfer = vk::PipelineStageFlags2::TRANSFER;
    let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(shared.family);
    // SAFETY: handles are used on this thread only and destroyed after the wait.
    unsafe {
        let pool = raw.create_command_pool(&pool_info, None).map_err(|e| driver("vkCreateCommandPool", e))?;
        let submit = |fence| {
            let info = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            let commands = raw.allocate_command_buffers(&info).map_err(|e| driver("vkAllocateCommandBuffers", e))?[0];
            raw.begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default())
                .map_err(|e| driver("vkBeginCommandBuffer", e))?;
            let access = vk::AccessFlags2::TRANSFER_READ | vk::AccessFlags2::TRANSFER_WRITE;
            memory_barrier(raw, commands, vk::PipelineStageFlags2::ALL_COMMANDS, transfer, access);
            raw.cmd_copy_buffer(commands, from, to, &[region]);
            memory_barrier(raw, commands, STAGES, vk::PipelineStageFlags2::HOST, vk::AccessFlags2::HOST_READ);
            raw.end_command_buffer(commands).map_err(|e| driver("vkEndCommandBuffer", e))?;
            let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
            let info = vk::SubmitInfo2::default().command_buffer_infos(&buffers);
            let submitted = shared.queue.submit(raw, info, fence).map_err(|e| shared.failed("vkQueueSubmit2", e));
            if !is_under_way(&submitted) {
                return submitted;
            }
            raw.wait_for_fences(&[fence], true, u64::MAX).map_err(|e| shared.failed("vkWaitForFences", e))?;
            shared.check_lost()
        };
        // A fence, not the whole queue: that may be an app's.
        let fence = raw.create_fence(&vk::FenceCreateInfo::default(), None);
        let result = fence.map_err(|e| driver("vkCreateFence", e)).and_then(|fence| {
            let result = submit(fence);
            raw.destroy_fence(fence, None);
            result
        });
        raw.destroy_command_pool(pool, None);
        result
    }
}

/// The error for a failed call.
pub(super) fn driver(call: &'static str, result: vk::Result) -> Error {
    match result {
        vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost,
        result => Error::Driver { call, result: result.to_string() },
    }
}
