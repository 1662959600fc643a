//! Runs that are under way while the host does something else.

use super::{Run, twins::Twins};
use crate::Result;

impl Run {
    /// Prepares for [`Run::start`]: inputs and outputs then move with the run, also where the host does not see the
    /// device's memory.
    ///
    /// # Errors
    /// [`crate::Error::Memory`] where the host has no room for them.
    pub fn in_flight(mut self) -> Result<Self> {
        self.flies = true;
        self.make_twins()?;
        Ok(self)
    }

    /// Twins for the memory that the lane has now.
    pub(super) fn make_twins(&mut self) -> Result<()> {
        let arena = self.lane.memory();
        if let Some(twins) = self.twins.take() {
            // SAFETY: the lane is settled, so neither is under way.
            unsafe { self.device.0.raw.free_command_buffers(self.pool, &[twins.upload, twins.download]) };
        }
        if self.flies && !arena.is_seen_by_host() {
            let buffers = [self.command_buffer()?, self.command_buffer()?];
            self.twins = Some(Twins::new(&self.device, &self.plan, &arena, buffers)?);
        }
        Ok(())
    }

    /// Submits the whole plan and returns at once. What comes next waits for it: [`Run::finish`], a write, another run.
    ///
    /// # Errors
    /// As [`Run::execute`].
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

    /// Waits for what was started. Outputs can be read then.
    ///
    /// # Errors
    /// As [`Run::execute`].
    pub fn finish(&mut self) -> Result<()> {
        self.settle()?;
        self.device.0.check_messages()
    }

    /// Waits where something is under way: what was started, or a copy, until which the host may change nothing that it
    /// reads.
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
