use crate::{
    Result,
    device::{
        Shared,
        barrier::{STAGES, memory_barrier},
        failure::{driver, is_in_flight},
    },
};
use ash::vk;

/// Copies `(from, to, region)` after all earlier submissions.
pub(crate) fn record_copies(
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

pub(crate) fn copy_now(shared: &Shared, from: vk::Buffer, to: vk::Buffer, region: vk::BufferCopy) -> Result<()> {
    shared.check_lost()?;
    let raw = &shared.raw;
    let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(shared.family);
    // SAFETY: this thread alone uses the handles and destroys them after the wait.
    unsafe {
        let pool = raw.create_command_pool(&pool_info, None).map_err(|e| driver("vkCreateCommandPool", e))?;
        let submit = |fence| {
            let info = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            let commands = raw.allocate_command_buffers(&info).map_err(|e| driver("vkAllocateCommandBuffers", e))?[0];
            record_copies(shared, commands, &[(from, to, region)])?;
            let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
            let info = vk::SubmitInfo2::default().command_buffer_infos(&buffers);
            let submitted = shared.queue.submit(raw, info, fence).map_err(|e| shared.failed("vkQueueSubmit2", e));
            if !is_in_flight(&submitted) {
                return submitted;
            }
            raw.wait_for_fences(&[fence], true, u64::MAX).map_err(|e| shared.failed("vkWaitForFences", e))?;
            shared.check_lost()
        };
        // Does not wait for the app's submissions.
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
