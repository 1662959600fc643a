//! In-flight submissions, overlapped with work on the host.

use super::{Run, twins::Twins};
use crate::Result;

impl Run {
    /// Prepares for [`Run::start`]. Adds staging buffers if device memory is not host visible.
    ///
    /// # Errors
    /// [`crate::Error::Memory`] if the host has no memory for the staging buffers.
    pub fn in_flight(mut self) -> Result<Self> {
        self.flies = true;
        self.make_twins()?;
        Ok(self)
    }

    pub(super) fn make_twins(&mut self) -> Result<()> {
        let arena = self.lane.memory();
        if let Some(twins) = self.twins.take() {
            // SAFETY: the lane is settled, so neither is in flight.
            unsafe { self.device.0.raw.free_command_buffers(self.pool, &[twins.upload, twins.download]) };
        }
        if self.flies && !arena.is_seen_by_host() {
            let buffers = [self.command_buffer()?, self.command_buffer()?];
            self.twins = Some(Twins::new(&self.device, &self.plan, &arena, buffers)?);
        }
        Ok(())
    }

    /// Submits the whole plan without waiting. [`Run::finish`], writes and other runs of the lane
    /// wait for it.
    pub fn start(&mut self) -> Result<()> {
        self.begin()?;
        self.encode_all()?;
        self.under_way = true;
        let upload = self.twins.as_ref().map(|twins| twins.upload);
        let download = self.twins.as_ref().map(|twins| twins.download);
        let batches: Vec<_> = self.batches.iter().map(|batch| batch.commands).collect();
        for commands in upload.into_iter().chain(batches).chain(download) {
            self.submit(commands)?;
        }
        Ok(())
    }

    /// Waits for the started submission.
    pub fn finish(&mut self) -> Result<()> {
        self.settle()?;
        self.device.0.check_messages()
    }

    pub(super) fn settle(&mut self) -> Result<()> {
        if self.under_way || self.presenting.is_some() {
            self.lane.wait(self.signalled)?;
        }
        if self.under_way {
            self.under_way = false;
            self.forget_inputs();
        }
        Ok(())
    }
}
