//! Command encoding, with barriers between dependent commands.

use super::{
    bindings::{Bindings, BufferRange},
    descriptors::Descriptors,
    schedule::Piece,
};
use crate::{
    Result,
    device::{
        barrier::{READS, STAGES, WRITES, memory_barrier},
        failure::driver,
    },
    plan::{Command, Dispatch, Operation},
};
use ash::vk;

pub(crate) struct Encoder<'a> {
    bound: &'a Bindings<'a>,
    descriptors: &'a Descriptors,
    commands: vk::CommandBuffer,
    reads: Vec<BufferRange>,
    writes: Vec<BufferRange>,
    queries: Option<vk::QueryPool>,
    next_query: u32,
}

impl<'a> Encoder<'a> {
    /// Writes of earlier submissions become visible.
    pub fn begin(
        bound: &'a Bindings<'a>,
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
        self.synchronize(command);
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
                // SAFETY: recording; both ranges are inside their buffers and live tensors never
                // overlap.
                unsafe { self.raw().cmd_copy_buffer(self.commands, from.buffer, to.buffer, &[region]) };
            }
        }
        self.timestamp();
        Ok(())
    }

    /// Results become visible to the host.
    pub fn end(self) -> Result<()> {
        self.barrier(STAGES, vk::PipelineStageFlags2::HOST, vk::AccessFlags2::HOST_READ);
        // SAFETY: recording.
        unsafe { self.raw().end_command_buffer(self.commands) }.map_err(|e| driver("vkEndCommandBuffer", e))
    }

    fn raw(&self) -> &ash::Device {
        &self.bound.shared.raw
    }

    fn synchronize(&mut self, command: &Command) {
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
        let overlaps = |a: &[BufferRange], b: &[BufferRange]| a.iter().any(|x| b.iter().any(|y| x.overlaps(y)));
        let hazard =
            overlaps(&reads, &self.writes) || overlaps(&writes, &self.writes) || overlaps(&writes, &self.reads);
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
            // SAFETY: recording; the caller limits pieces to the pool's size.
            unsafe { self.raw().cmd_write_timestamp2(self.commands, stage, pool, self.next_query) };
            self.next_query += 1;
        }
    }

    fn dispatch(&self, dispatch: &Dispatch, piece: Piece) -> Result<()> {
        let module = dispatch.module;
        let pipeline = self.bound.shared.pipelines.get(module, &dispatch.constants)?;
        let sets = [self.descriptors.sets[piece.command]];
        let compute = vk::PipelineBindPoint::COMPUTE;
        let mut push = dispatch.push;
        for &(buffer, word) in module.addresses {
            let address = self.bound.range(dispatch.buffers[buffer]).address;
            push[word as usize..][..2].copy_from_slice(&[address as u32, (address >> 32) as u32]);
        }
        let push: &[u8] = &bytemuck::bytes_of(&push)[..module.push_bytes as usize];
        let (raw, commands) = (self.raw(), self.commands);
        // SAFETY: recording; all handles are alive, and the sets match the pipeline's layout.
        unsafe {
            raw.cmd_bind_pipeline(commands, compute, pipeline.raw);
            raw.cmd_bind_descriptor_sets(commands, compute, pipeline.layout, 0, &sets, &[]);
            if !push.is_empty() {
                raw.cmd_push_constants(commands, pipeline.layout, vk::ShaderStageFlags::COMPUTE, 0, push);
            }
            let ([x, y, z], [w, h, d]) = (piece.base, piece.groups);
            raw.cmd_dispatch_base(commands, x, y, z, w, h, d);
        }
        Ok(())
    }
}
