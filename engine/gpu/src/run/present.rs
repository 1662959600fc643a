use crate::{Error, Result, Run, Tensor, device::failure::driver};
use ash::vk::{self, Handle};

/// Destination in an app's device memory, with semaphores.
#[derive(Clone, Debug)]
pub struct Target {
    place: Place,
    waits: Vec<Point>,
    signals: Vec<Point>,
}

/// A value of a timeline semaphore.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    /// `VkSemaphore`.
    pub semaphore: u64,
    /// Value to wait for or to signal.
    pub value: u64,
}

/// Region of an image that a copy fills.
#[derive(Clone, Copy, Debug)]
pub struct ImagePlace {
    /// `VkImage` with the color aspect.
    pub image: u64,
    /// First pixel.
    pub offset: [u32; 2],
    /// Pixels along x and y.
    pub extent: [u32; 2],
    /// Mip level.
    pub mip_level: u32,
    /// Array layer.
    pub array_layer: u32,
    /// Current `VkImageLayout`.
    pub old_layout: i32,
    /// `VkImageLayout` after the copy.
    pub new_layout: i32,
}

#[derive(Clone, Copy, Debug)]
enum Place {
    Image(ImagePlace),
    Buffer { buffer: u64, offset: u64 },
}

impl Target {
    /// Targets an image of any tiling with transfer-destination usage.
    ///
    /// # Safety
    /// Image and semaphores belong to the run's device and live until the signals. The region is
    /// inside the image, which the queue's family owns, with the pixel size of the copied data.
    pub unsafe fn image(place: ImagePlace, waits: Vec<Point>, signals: Vec<Point>) -> Self {
        Self { place: Place::Image(place), waits, signals }
    }

    /// Targets a buffer with transfer-destination usage.
    ///
    /// # Safety
    /// As [`Target::image`]; the copied data fits after `offset`, a multiple of 4.
    pub unsafe fn buffer(buffer: u64, offset: u64, waits: Vec<Point>, signals: Vec<Point>) -> Self {
        Self { place: Place::Buffer { buffer, offset }, waits, signals }
    }
}

impl Run {
    /// Submits a copy of an output to `target` without waiting. The run's next write and its drop
    /// wait.
    ///
    /// # Errors
    /// [`Error::Argument`] for invalid handles or layouts, [`Error::DeviceLost`].
    ///
    /// # Panics
    /// If the tensor is no output, or another run used the lane.
    pub fn present(&mut self, tensor: Tensor, target: &Target) -> Result<()> {
        let handle = match target.place {
            Place::Image(place) => place.image,
            Place::Buffer { buffer, .. } => buffer,
        };
        if handle == 0 || target.waits.iter().chain(&target.signals).any(|point| point.semaphore == 0) {
            return Err(Error::argument("Vulkan handles", "a null one", "an image or buffer, and semaphores"));
        }
        if let Place::Image(ImagePlace { new_layout: 0 | 8, .. }) = target.place {
            return Err(Error::argument("new layout", "undefined or preinitialized", "a layout for use"));
        }
        assert!(self.lane.holds(self.id), "presented after another run of the lane");
        self.device.0.check_lost()?;
        self.settle()?;
        let commands = match self.presenting {
            Some(commands) => commands,
            None => *self.presenting.insert(self.command_buffer()?),
        };
        self.record_copy(commands, tensor, target.place)?;
        self.submit_between(commands, &target.waits, &target.signals).map(drop)
    }

    fn record_copy(&self, commands: vk::CommandBuffer, tensor: Tensor, place: Place) -> Result<()> {
        let id = tensor.allocation();
        assert!(self.plan.allocations[id].kept, "{} is not kept", self.plan.allocations[id].name);
        let from = self.plan.placements[id];
        let (source, offset) = (self.lane.memory().buffer(from.block), from.offset + tensor.offset);
        let raw = &self.device.0.raw;
        let transfer = vk::PipelineStageFlags2::TRANSFER;
        // SAFETY: not in flight; the source is inside its block; the creator vouches for the
        // target.
        unsafe {
            raw.begin_command_buffer(commands, &vk::CommandBufferBeginInfo::default())
                .map_err(|e| driver("vkBeginCommandBuffer", e))?;
            let written = vk::MemoryBarrier2::default()
                .src_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
                .src_access_mask(vk::AccessFlags2::MEMORY_WRITE)
                .dst_stage_mask(transfer)
                .dst_access_mask(vk::AccessFlags2::TRANSFER_READ | vk::AccessFlags2::TRANSFER_WRITE);
            let done = vk::MemoryBarrier2::default()
                .src_stage_mask(transfer)
                .src_access_mask(vk::AccessFlags2::TRANSFER_WRITE)
                .dst_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS | vk::PipelineStageFlags2::HOST)
                .dst_access_mask(READ_AND_WRITE | vk::AccessFlags2::HOST_READ);
            match place {
                Place::Buffer { buffer, offset: dst_offset } => {
                    let region = vk::BufferCopy { src_offset: offset, dst_offset, size: tensor.bytes };
                    raw.cmd_pipeline_barrier2(commands, &vk::DependencyInfo::default().memory_barriers(&[written]));
                    raw.cmd_copy_buffer(commands, source, vk::Buffer::from_raw(buffer), &[region]);
                    raw.cmd_pipeline_barrier2(commands, &vk::DependencyInfo::default().memory_barriers(&[done]));
                }
                Place::Image(place) => {
                    let image = vk::Image::from_raw(place.image);
                    let dst = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
                    let before = [image_barrier(&place)
                        .src_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
                        .src_access_mask(READ_AND_WRITE)
                        .dst_stage_mask(transfer)
                        .dst_access_mask(vk::AccessFlags2::TRANSFER_WRITE)
                        .old_layout(vk::ImageLayout::from_raw(place.old_layout))
                        .new_layout(dst)];
                    let after = [image_barrier(&place)
                        .src_stage_mask(transfer)
                        .src_access_mask(vk::AccessFlags2::TRANSFER_WRITE)
                        .dst_stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
                        .dst_access_mask(READ_AND_WRITE)
                        .old_layout(dst)
                        .new_layout(vk::ImageLayout::from_raw(place.new_layout))];
                    let before = vk::DependencyInfo::default()
                        .memory_barriers(std::slice::from_ref(&written))
                        .image_memory_barriers(&before);
                    raw.cmd_pipeline_barrier2(commands, &before);
                    raw.cmd_copy_buffer_to_image(commands, source, image, dst, &[region(&place, offset)]);
                    raw.cmd_pipeline_barrier2(commands, &vk::DependencyInfo::default().image_memory_barriers(&after));
                }
            }
            raw.end_command_buffer(commands).map_err(|e| driver("vkEndCommandBuffer", e))
        }
    }
}

const READ_AND_WRITE: vk::AccessFlags2 =
    vk::AccessFlags2::from_raw(vk::AccessFlags2::MEMORY_READ.as_raw() | vk::AccessFlags2::MEMORY_WRITE.as_raw());

fn image_barrier(place: &ImagePlace) -> vk::ImageMemoryBarrier2<'static> {
    let range = vk::ImageSubresourceRange::default()
        .aspect_mask(vk::ImageAspectFlags::COLOR)
        .base_mip_level(place.mip_level)
        .level_count(1)
        .base_array_layer(place.array_layer)
        .layer_count(1);
    vk::ImageMemoryBarrier2::default()
        .image(vk::Image::from_raw(place.image))
        .subresource_range(range)
        .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
        .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
}

fn region(place: &ImagePlace, buffer_offset: u64) -> vk::BufferImageCopy {
    let layers = vk::ImageSubresourceLayers::default()
        .aspect_mask(vk::ImageAspectFlags::COLOR)
        .mip_level(place.mip_level)
        .base_array_layer(place.array_layer)
        .layer_count(1);
    let ([x, y], [width, height]) = (place.offset, place.extent);
    vk::BufferImageCopy::default()
        .buffer_offset(buffer_offset)
        .image_subresource(layers)
        .image_offset(vk::Offset3D { x: x as i32, y: y as i32, z: 0 })
        .image_extent(vk::Extent3D { width, height, depth: 1 })
}

pub(super) fn submit_info(point: &Point) -> vk::SemaphoreSubmitInfo<'static> {
    vk::SemaphoreSubmitInfo::default()
        .semaphore(vk::Semaphore::from_raw(point.semaphore))
        .value(point.value)
        .stage_mask(vk::PipelineStageFlags2::ALL_COMMANDS)
}
