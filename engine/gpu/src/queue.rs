//! The queue that everything is submitted to, which an app may share.

use super::lock::lock;
use ash::{prelude::VkResult, vk};
use std::sync::Mutex;

/// An app's own lock on its queue. Both are called on the thread that submits, `unlock` right after the submission: the
/// lock is never held while the engine waits for the device.
pub struct QueueLock {
    /// Returns when nobody else uses the queue.
    pub lock: Box<dyn Fn() + Send + Sync>,
    /// Lets others use it again.
    pub unlock: Box<dyn Fn() + Send + Sync>,
}

pub(super) struct Queue {
    raw: Mutex<vk::Queue>,
    app: Option<QueueLock>,
}

impl Queue {
    pub fn new(raw: vk::Queue, app: Option<QueueLock>) -> Self {
        Self { raw: Mutex::new(raw), app }
    }

    /// # Safety
    /// As `vkQueueSubmit2`, but for the queue, which is locked here.
    pub unsafe fn submit(&self, device: &ash::Device, info: vk::SubmitInfo2<'_>, fence: vk::Fence) -> VkResult<()> {
        let queue = lock(&self.raw);
        if let Some(app) = &self.app {
            (app.lock)();
        }
        // SAFETY: the queue is locked; the caller answers for the rest.
        let result = unsafe { device.queue_submit2(*queue, &[info], fence) };
        if let Some(app) = &self.app {
            (app.unlock)();
        }
        result
    }

    /// Waits for all that was submitted.
    pub fn wait_idle(&self, device: &ash::Device) -> VkResult<()> {
        let queue = lock(&self.raw);
        // SAFETY: the queue is locked.
        unsafe { device.queue_wait_idle(*queue) }
    }
}
