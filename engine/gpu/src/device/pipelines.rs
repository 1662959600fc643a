//! Compute pipelines, one per set of specialization constants.

use crate::{
    Error, Result,
    lock::lock,
    plan::kernel::{LocalSize, Module},
};
use ash::{ext, vk};
use std::{
    collections::{HashMap, hash_map::Entry},
    sync::Mutex,
};

pub(crate) struct Pipelines {
    raw: ash::Device,
    debug: Option<ext::debug_utils::Device>,
    subgroup: u32,
    subgroup_control: bool,
    cache: Mutex<HashMap<(&'static str, Vec<u32>), Pipeline>>,
    layouts: Mutex<HashMap<&'static str, Layout>>,
}

impl Pipelines {
    pub fn new(
        raw: ash::Device,
        debug: Option<ext::debug_utils::Device>,
        subgroup: u32,
        subgroup_control: bool,
    ) -> Self {
        Self { raw, debug, subgroup, subgroup_control, cache: Mutex::default(), layouts: Mutex::default() }
    }

    /// None may be in use.
    pub fn destroy(&self) {
        let raw = &self.raw;
        for pipeline in lock(&self.cache).values() {
            // SAFETY: made on this device and unused.
            unsafe { raw.destroy_pipeline(pipeline.raw, None) };
        }
        for layout in lock(&self.layouts).values() {
            layout.destroy(raw);
        }
    }

    pub fn get(&self, module: &'static Module, constants: &[u32]) -> Result<Pipeline> {
        let key = (module.name, constants.to_vec());
        if let Some(found) = lock(&self.cache).get(&key) {
            return Ok(*found);
        }
        let layout = self.layout(module)?;
        let subgroup = self.subgroup;
        let mut values = constants.to_vec();
        let mut ids = module.constant_ids.to_vec();
        let whole_subgroups = !matches!(module.local_size, LocalSize::Fixed(_));
        if whole_subgroups {
            // Sorted by ID: validation 1.4.309 uses the ID of a matrix size as an index.
            ids.insert(0, 0);
            values.insert(0, module.local_size.xyz(subgroup, constants)[0]);
        }
        let entries: Vec<_> = (ids.iter().zip(0u32..))
            .map(|(id, i)| vk::SpecializationMapEntry { constant_id: *id, offset: 4 * i, size: 4 })
            .collect();
        let specialization =
            vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::cast_slice(&values));
        let mut size =
            vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default().required_subgroup_size(subgroup);
        let mut stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(layout.module)
            .name(c"main")
            .specialization_info(&specialization);
        if whole_subgroups {
            stage = stage.flags(vk::PipelineShaderStageCreateFlags::REQUIRE_FULL_SUBGROUPS);
            if self.subgroup_control {
                stage = stage.push_next(&mut size);
            }
        }
        let info = vk::ComputePipelineCreateInfo::default()
            .flags(vk::PipelineCreateFlags::DISPATCH_BASE)
            .stage(stage)
            .layout(layout.pipeline);
        // SAFETY: all pointers in `info` are alive.
        let raw = unsafe { self.raw.create_compute_pipelines(vk::PipelineCache::null(), &[info], None) }.map_err(
            |(_, e)| Error::Driver { call: "vkCreateComputePipelines", result: format!("{}: {e}", module.name) },
        )?[0];
        self.label(raw, module.name);
        match lock(&self.cache).entry(key) {
            Entry::Occupied(known) => {
                // SAFETY: made above and unused.
                unsafe { self.raw.destroy_pipeline(raw, None) };
                Ok(*known.get())
            }
            Entry::Vacant(place) => Ok(*place.insert(Pipeline { raw, layout: layout.pipeline })),
        }
    }

    pub fn set_layout(&self, module: &'static Module) -> Result<vk::DescriptorSetLayout> {
        self.layout(module).map(|layout| layout.set)
    }

    fn layout(&self, module: &'static Module) -> Result<Layout> {
        let mut layouts = lock(&self.layouts);
        if let Some(known) = layouts.get(module.name) {
            return Ok(*known);
        }
        let mut layout = Layout::default();
        if let Err(error) = self.make_layout(module, &mut layout) {
            layout.destroy(&self.raw);
            return Err(error);
        }
        layouts.insert(module.name, layout);
        Ok(layout)
    }

    fn make_layout(&self, module: &'static Module, layout: &mut Layout) -> Result<()> {
        let bindings: Vec<_> = module
            .bindings
            .iter()
            .map(|b| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(b.binding)
                    .descriptor_count(1)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let set_info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        let failed = |call| move |e: vk::Result| Error::Driver { call, result: format!("{}: {e}", module.name) };
        let words = ash::util::read_spv(&mut std::io::Cursor::new(module.spirv))
            .map_err(|e| Error::Driver { call: "read_spv", result: format!("{}: {e}", module.name) })?;
        let push =
            [vk::PushConstantRange::default().stage_flags(vk::ShaderStageFlags::COMPUTE).size(module.push_bytes)];
        let raw = &self.raw;
        // SAFETY: valid create infos; the caller destroys the handles, here or with the device.
        unsafe {
            layout.set =
                raw.create_descriptor_set_layout(&set_info, None).map_err(failed("vkCreateDescriptorSetLayout"))?;
            let sets = [layout.set];
            let mut info = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
            if module.push_bytes > 0 {
                info = info.push_constant_ranges(&push);
            }
            layout.pipeline = raw.create_pipeline_layout(&info, None).map_err(failed("vkCreatePipelineLayout"))?;
            let info = vk::ShaderModuleCreateInfo::default().code(&words);
            layout.module = raw.create_shader_module(&info, None).map_err(failed("vkCreateShaderModule"))?;
        }
        Ok(())
    }

    fn label(&self, pipeline: vk::Pipeline, name: &str) {
        let Some(debug) = &self.debug else { return };
        let name = std::ffi::CString::new(name).unwrap_or_default();
        let info = vk::DebugUtilsObjectNameInfoEXT::default().object_handle(pipeline).object_name(&name);
        // SAFETY: the pipeline is alive. Failing to set a label is harmless.
        let _ = unsafe { debug.set_debug_utils_object_name(&info) };
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Pipeline {
    pub raw: vk::Pipeline,
    pub layout: vk::PipelineLayout,
}

#[derive(Clone, Copy, Default)]
struct Layout {
    set: vk::DescriptorSetLayout,
    pipeline: vk::PipelineLayout,
    module: vk::ShaderModule,
}

impl Layout {
    fn destroy(&self, raw: &ash::Device) {
        // SAFETY: made on this device and unused.
        unsafe {
            raw.destroy_shader_module(self.module, None);
            raw.destroy_pipeline_layout(self.pipeline, None);
            raw.destroy_descriptor_set_layout(self.set, None);
        }
    }
}
