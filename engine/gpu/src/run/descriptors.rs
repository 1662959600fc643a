//! Descriptors of dispatches, written once because buffers never move.

use super::bindings::Bindings;
use crate::{
    Device, Result,
    device::failure::driver,
    plan::{Command, Dispatch, Operation},
};
use ash::vk;

pub(crate) struct Descriptors {
    device: Device,
    pool: vk::DescriptorPool,
    /// By command; null for fills and copies.
    pub sets: Vec<vk::DescriptorSet>,
}

impl Descriptors {
    pub fn new(device: &Device, bound: &Bindings<'_>) -> Result<Self> {
        let commands = &bound.plan.commands;
        let bindings: usize = commands.iter().filter_map(dispatch).map(|d| d.buffers.len()).sum();
        let sizes = [vk::DescriptorPoolSize {
            ty: vk::DescriptorType::STORAGE_BUFFER,
            descriptor_count: bindings.max(1) as u32,
        }];
        let info = vk::DescriptorPoolCreateInfo::default().max_sets(commands.len().max(1) as u32).pool_sizes(&sizes);
        // SAFETY: a valid create info; destroyed in `drop`.
        let pool = unsafe { device.0.raw.create_descriptor_pool(&info, None) }
            .map_err(|e| driver("vkCreateDescriptorPool", e))?;
        let mut descriptors = Self { device: device.clone(), pool, sets: Vec::with_capacity(commands.len()) };
        for command in commands {
            let set = dispatch(command).map(|dispatch| descriptors.set(bound, dispatch)).transpose()?;
            descriptors.sets.push(set.unwrap_or_default());
        }
        Ok(descriptors)
    }

    fn set(&self, bound: &Bindings<'_>, dispatch: &Dispatch) -> Result<vk::DescriptorSet> {
        let raw = &self.device.0.raw;
        let layouts = [self.device.0.pipelines.set_layout(dispatch.module)?];
        let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(self.pool).set_layouts(&layouts);
        // SAFETY: the pool has capacity for all dispatches, and only this object uses it.
        let set = unsafe { raw.allocate_descriptor_sets(&info) }.map_err(|e| driver("vkAllocateDescriptorSets", e))?[0];
        let infos: Vec<_> = dispatch.buffers.iter().map(|tensor| [bound.range(*tensor).descriptor()]).collect();
        let writes: Vec<_> = (dispatch.module.bindings.iter().zip(&infos))
            .map(|(binding, info)| {
                vk::WriteDescriptorSet::default()
                    .dst_set(set)
                    .dst_binding(binding.binding)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .buffer_info(info)
            })
            .collect();
        // SAFETY: the set is new and matches the module's bindings; the buffers are alive.
        unsafe { raw.update_descriptor_sets(&writes, &[]) };
        Ok(set)
    }
}

impl Drop for Descriptors {
    fn drop(&mut self) {
        // SAFETY: the owning run has waited for its submissions.
        unsafe { self.device.0.raw.destroy_descriptor_pool(self.pool, None) };
    }
}

fn dispatch(command: &Command) -> Option<&Dispatch> {
    match &command.operation {
        Operation::Dispatch(dispatch) => Some(dispatch),
        _ => None,
    }
}
