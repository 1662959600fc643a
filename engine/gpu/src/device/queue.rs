use crate::lock::lock;
use ash::{prelude::VkResult, vk};
use std::sync::Mutex;

/// An app's lock on its queue. Submitting threads call both functions and never wait in between.
pub struct QueueLock {
    /// Blocks until the queue is free and takes it.
    pub lock: Box<dyn Fn() + Send + Sync>,
    /// Releases the queue.
    pub unlock: Box<dyn Fn() + Send + Sync>,
}

pub(crate) struct Queue {
    raw: Mutex<vk::Queue>,
    app: Option<QueueLock>,
}

impl Queue {
    pub fn new(raw: vk::Queue, app: Option<QueueLock>) -> Self {
        Self { raw: Mutex::new(raw), app }
    }

    /// # Safety
    /// As for `vkQueueSubmit2`; this function locks the queue.
    pub unsafe fn submit(&self, device: &ash::Device, info: vk::SubmitInfo2<'_>, fence: vk::Fence) -> VkResult<()> {
        let queue = lock(&self.raw);
        if let Some(app) = &self.app {
            (app.lock)();
        }
        // SAFETY: the queue is locked; the caller vouches for the rest.
        let result = unsafe { device.queue_submit2(*queue, &[info], fence) };
        if let Some(app) = &self.app {
            (app.unlock)();
        }
        result
    }

    pub fn wait_idle(&self, device: &ash::Device) -> VkResult<()> {
        let queue = lock(&self.raw);
        // SAFETY: the queue is locked.
        unsafe { device.queue_wait_idle(*queue) }
    }
}
