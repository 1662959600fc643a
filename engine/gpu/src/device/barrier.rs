use ash::vk;

pub(crate) const WRITES: vk::AccessFlags2 = vk::AccessFlags2::from_raw(
    vk::AccessFlags2::SHADER_STORAGE_WRITE.as_raw() | vk::AccessFlags2::TRANSFER_WRITE.as_raw(),
);
pub(crate) const READS: vk::AccessFlags2 = vk::AccessFlags2::from_raw(
    vk::AccessFlags2::SHADER_STORAGE_READ.as_raw() | vk::AccessFlags2::TRANSFER_READ.as_raw(),
);
pub(crate) const STAGES: vk::PipelineStageFlags2 = vk::PipelineStageFlags2::from_raw(
    vk::PipelineStageFlags2::COMPUTE_SHADER.as_raw() | vk::PipelineStageFlags2::TRANSFER.as_raw(),
);

pub(crate) fn memory_barrier(
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
    // SAFETY: callers are recording into `commands`.
    unsafe { raw.cmd_pipeline_barrier2(commands, &info) };
}
