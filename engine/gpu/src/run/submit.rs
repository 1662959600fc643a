//! Submitting what is encoded, and waiting for it.

use super::Run;
use crate::{Result, commands::driver, lost::is_under_way};
use ash::vk;

impl Run {
    /// Submits; the timeline's value that says that it is done.
    pub(crate) fn submit(&mut self, commands: vk::CommandBuffer) -> Result<u64> {
        self.device.0.check_lost()?;
        let value = self.lane.next_value()?;
        let submitted = self.submit_as(commands, value);
        if is_under_way(&submitted) {
            self.signalled = value;
        }
        submitted.map(|()| value)
    }

    pub(crate) fn submit_as(&self, commands: vk::CommandBuffer, value: u64) -> Result<()> {
        let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
        let signals = [vk::SemaphoreSubmitInfo::default()
            .semaphore(self.lane.timeline())
            .value(value)
            .stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)];
        let info = vk::SubmitInfo2::default().command_buffer_infos(&buffers).signal_semaphore_infos(&signals);
        // SAFETY: the command buffer is recorded and not under way.
        let submitted = unsafe { self.device.0.queue.submit(&self.device.0.raw, info, vk::Fence::null()) }
            .map_err(|e| self.device.0.failed("vkQueueSubmit2", e));
        self.lane.submitted(value, &submitted);
        submitted
    }

    pub(crate) fn command_buffer(&self) -> Result<vk::CommandBuffer> {
        let info = vk::CommandBufferAllocateInfo::default().command_pool(self.pool).command_buffer_count(1);
        // SAFETY: the pool is used by this run only, which is borrowed by one thread at a time.
        unsafe { self.device.0.raw.allocate_command_buffers(&info) }
            .map(|buffers| buffers[0])
            .map_err(|e| driver("vkAllocateCommandBuffers", e))
    }
}
