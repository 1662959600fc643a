pub(crate) mod arena;
mod copy;
mod element;
pub(crate) mod staging;
pub(crate) mod tensor;

pub use arena::{Arena, Claim};
pub use element::Element;
pub use tensor::Tensor;

use self::tensor::Home;
use crate::{Device, Error, Result, device::Shared, lock::lock, plan::layout::ALIGNMENT};
use ash::vk;
use bytemuck::Pod;
use gpu_allocator::{
    MemoryLocation,
    vulkan::{Allocation, AllocationCreateDesc, AllocationScheme},
};
use std::sync::{
    Arc, Mutex,
    atomic::{AtomicU64, Ordering},
};

const STAGING_BYTES: u64 = 16 << 20;

pub(crate) struct Memory {
    shared: Arc<Shared>,
    blocks: Vec<Block>,
    staging: Mutex<Option<Block>>,
}

struct Block {
    buffer: vk::Buffer,
    allocation: Option<Allocation>,
    bytes: u64,
    address: u64,
    /// Counts as device memory, unlike host-cached memory of discrete GPUs.
    counted: bool,
    mapped: bool,
}

impl Memory {
    pub fn new(device: &Device, name: &str, sizes: &[u64]) -> Result<Self> {
        Self::at(device, name, sizes, MemoryLocation::GpuOnly)
    }

    pub fn host_visible(device: &Device, name: &str, bytes: u64) -> Result<Self> {
        Self::at(device, name, &[bytes], MemoryLocation::GpuToCpu)
    }

    fn at(device: &Device, name: &str, sizes: &[u64], location: MemoryLocation) -> Result<Self> {
        let shared = device.0.clone();
        shared.check_lost()?;
        let needed: u64 = sizes.iter().sum();
        let available = shared.limits.memory_bytes.saturating_sub(shared.allocated.load(Ordering::Relaxed));
        if needed > available && location == MemoryLocation::GpuOnly {
            return Err(Error::Memory { what: name.into(), needed, available });
        }
        let mut memory = Self { shared, blocks: Vec::new(), staging: Mutex::new(None) };
        for &bytes in sizes {
            let block = Block::new(&memory.shared, name, bytes, location)?;
            memory.blocks.push(block);
        }
        Ok(memory)
    }

    pub fn bytes(&self) -> u64 {
        self.blocks.iter().map(|block| block.bytes).sum()
    }

    pub fn is_host_visible(&self) -> bool {
        self.blocks.iter().all(|block| block.mapped)
    }

    pub fn buffer(&self, block: u32) -> vk::Buffer {
        self.blocks[block as usize].buffer
    }

    pub fn address(&self, block: u32) -> u64 {
        self.blocks[block as usize].address
    }

    pub fn write(&self, block: u32, offset: u64, bytes: &[u8]) -> Result<()> {
        self.shared.check_lost()?;
        let target = &self.blocks[block as usize];
        if let Some(memory) = target.bytes_at(offset, bytes.len()) {
            // SAFETY: checked bounds, mapped, and no submission uses the range: runs are exclusive.
            unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), memory, bytes.len()) };
            return Ok(());
        }
        let staging = self.staging()?;
        let stage = staging.as_ref().expect("made above");
        for (i, chunk) in bytes.chunks(STAGING_BYTES as usize).enumerate() {
            let memory = stage.bytes_at(0, chunk.len()).ok_or_else(unmapped)?;
            // SAFETY: as above; the staging block is locked.
            unsafe { std::ptr::copy_nonoverlapping(chunk.as_ptr(), memory, chunk.len()) };
            let at = offset + i as u64 * STAGING_BYTES;
            self.transfer(stage.buffer, 0, target.buffer, at, chunk.len() as u64)?;
        }
        Ok(())
    }

    pub fn read(&self, block: u32, offset: u64, bytes: &mut [u8]) -> Result<()> {
        self.shared.check_lost()?;
        let source = &self.blocks[block as usize];
        if let Some(memory) = source.bytes_at(offset, bytes.len()) {
            // SAFETY: as in `write`.
            unsafe { std::ptr::copy_nonoverlapping(memory, bytes.as_mut_ptr(), bytes.len()) };
            return Ok(());
        }
        let staging = self.staging()?;
        let stage = staging.as_ref().expect("made above");
        for (i, chunk) in bytes.chunks_mut(STAGING_BYTES as usize).enumerate() {
            let at = offset + i as u64 * STAGING_BYTES;
            self.transfer(source.buffer, at, stage.buffer, 0, chunk.len() as u64)?;
            let memory = stage.bytes_at(0, chunk.len()).ok_or_else(unmapped)?;
            // SAFETY: as in `write`.
            unsafe { std::ptr::copy_nonoverlapping(memory, chunk.as_mut_ptr(), chunk.len()) };
        }
        Ok(())
    }

    /// Host-cached, because uncached reads are very slow.
    fn staging(&self) -> Result<std::sync::MutexGuard<'_, Option<Block>>> {
        let mut staging = lock(&self.staging);
        if staging.is_none() {
            *staging = Some(Block::new(&self.shared, "staging", STAGING_BYTES, MemoryLocation::GpuToCpu)?);
        }
        Ok(staging)
    }

    fn transfer(&self, from: vk::Buffer, from_at: u64, to: vk::Buffer, to_at: u64, bytes: u64) -> Result<()> {
        let size = bytes.next_multiple_of(4);
        let region = vk::BufferCopy { src_offset: from_at, dst_offset: to_at, size };
        crate::memory::copy::copy_now(&self.shared, from, to, region)
    }
}

impl Drop for Memory {
    fn drop(&mut self) {
        for block in self.blocks.drain(..).chain(lock(&self.staging).take()) {
            block.free(&self.shared);
        }
    }
}

impl Block {
    fn new(shared: &Shared, name: &str, bytes: u64, location: MemoryLocation) -> Result<Self> {
        let addresses = shared.limits.addresses;
        let mut usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        if addresses {
            usage |= vk::BufferUsageFlags::SHADER_DEVICE_ADDRESS;
        }
        let info = vk::BufferCreateInfo::default().size(bytes).usage(usage);
        // No driver reports available memory, which other programs use and which may be fragmented.
        let refused = || {
            let available = shared.limits.memory_bytes.saturating_sub(shared.allocated.load(Ordering::Relaxed));
            Error::Memory { what: format!("{name}, which the driver refused,"), needed: bytes, available }
        };
        let buffer = unsafe { shared.raw.create_buffer(&info, None) }.map_err(|_| refused())?;
        let counted = location == MemoryLocation::GpuOnly;
        shared.allocated.fetch_add(if counted { bytes } else { 0 }, Ordering::Relaxed);
        let mut block = Self { buffer, allocation: None, bytes, address: 0, counted, mapped: false };
        // SAFETY: the buffer was just made on this device.
        let requirements = unsafe { shared.raw.get_buffer_memory_requirements(buffer) };
        let allocation = shared.allocator().allocate(&AllocationCreateDesc {
            name,
            requirements,
            location,
            linear: true,
            allocation_scheme: AllocationScheme::DedicatedBuffer(buffer),
        });
        let Ok(allocation) = allocation else {
            block.free(shared);
            return Err(refused());
        };
        let is = |property| allocation.memory_properties().contains(property);
        // Uncached reads are very slow.
        let direct = is(vk::MemoryPropertyFlags::HOST_CACHED) && !shared.force_staging;
        let seen = is(vk::MemoryPropertyFlags::HOST_COHERENT) && (direct || location != MemoryLocation::GpuOnly);
        block.mapped = seen && allocation.mapped_ptr().is_some();
        // SAFETY: both belong together and are bound once.
        let bound = unsafe { shared.raw.bind_buffer_memory(buffer, allocation.memory(), allocation.offset()) };
        block.allocation = Some(allocation);
        if let Err(e) = bound {
            block.free(shared);
            return Err(crate::device::failure::driver("vkBindBufferMemory", e));
        }
        if addresses {
            let info = vk::BufferDeviceAddressInfo::default().buffer(buffer);
            // SAFETY: the buffer allows it and is bound.
            block.address = unsafe { shared.raw.get_buffer_device_address(&info) };
        }
        Ok(block)
    }

    fn bytes_at(&self, offset: u64, len: usize) -> Option<*mut u8> {
        assert!(offset + len as u64 <= self.bytes, "host access outside a block");
        let base = self.allocation.as_ref()?.mapped_ptr().filter(|_| self.mapped)?;
        // SAFETY: in bounds, as asserted.
        Some(unsafe { base.as_ptr().cast::<u8>().add(offset as usize) })
    }

    fn free(self, shared: &Shared) {
        shared.allocated.fetch_sub(if self.counted { self.bytes } else { 0 }, Ordering::Relaxed);
        // SAFETY: users wait for their submissions before they drop their memory.
        unsafe { shared.raw.destroy_buffer(self.buffer, None) };
        if let Some(allocation) = self.allocation {
            // Fails only for memory of another allocator.
            let _ = shared.allocator().free(allocation);
        }
    }
}

fn unmapped() -> Error {
    Error::Driver { call: "vkMapMemory", result: "staging memory is not host visible".into() }
}

/// Layout of tensors that stay on the device, such as weights and scenes.
#[derive(Debug)]
pub struct ResidentLayout {
    id: u64,
    blocks: Vec<u64>,
    block_bytes: u64,
}

impl ResidentLayout {
    /// Creates an empty layout.
    pub fn new(limits: &crate::Limits) -> Self {
        static LAYOUTS: AtomicU64 = AtomicU64::new(0);
        let id = LAYOUTS.fetch_add(1, Ordering::Relaxed);
        Self { id, blocks: Vec::new(), block_bytes: limits.max_block_bytes }
    }

    /// Adds a tensor of `len` elements.
    pub fn add<T>(&mut self, len: usize) -> Tensor {
        let bytes = (len * size_of::<T>()) as u64;
        let padded = bytes.next_multiple_of(ALIGNMENT).max(ALIGNMENT);
        if self.blocks.last().is_none_or(|used| used + padded > self.block_bytes) {
            self.blocks.push(0);
        }
        let block = self.blocks.len() - 1;
        let offset = self.blocks[block];
        self.blocks[block] += padded;
        Tensor { home: Home::Resident { layout: self.id, block: block as u32 }, offset, bytes }
    }

    /// Returns the bytes of all tensors.
    pub fn bytes(&self) -> u64 {
        self.blocks.iter().sum()
    }
}

/// Device memory of one layout, kept across runs.
pub struct Resident {
    pub(crate) memory: Memory,
    pub(crate) layout: u64,
}

impl Resident {
    /// Allocates a layout.
    pub fn new(device: &Device, layout: &ResidentLayout) -> Result<Self> {
        let memory = Memory::new(device, "resident memory", &layout.blocks)?;
        Ok(Self { memory, layout: layout.id })
    }

    /// Writes a tensor from its start.
    pub fn write<T: Pod>(&self, tensor: Tensor, data: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        assert!(bytes.len() as u64 <= tensor.bytes, "{} bytes into {}", bytes.len(), tensor.bytes);
        self.memory.write(self.block(tensor), tensor.offset, bytes)
    }

    /// Reads a tensor, after the runs that write it.
    pub fn read<T: Pod>(&self, tensor: Tensor) -> Result<Vec<T>> {
        let mut data = vec![T::zeroed(); tensor.bytes as usize / size_of::<T>()];
        self.memory.read(self.block(tensor), tensor.offset, bytemuck::cast_slice_mut(&mut data))?;
        Ok(data)
    }

    /// Returns the bytes of all tensors.
    pub fn bytes(&self) -> u64 {
        self.memory.bytes()
    }

    /// Returns true if the memory is on this device.
    pub fn is_on(&self, device: &Device) -> bool {
        Arc::ptr_eq(&self.memory.shared, &device.0)
    }

    fn block(&self, tensor: Tensor) -> u32 {
        match tensor.home {
            Home::Resident { layout, block } if layout == self.layout => block,
            _ => panic!("a tensor of another memory"),
        }
    }
}
