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
        if !self.arena.is_seen_by_host() {
            let buffers = [self.command_buffer()?, self.command_buffer()?];
            self.twins = Some(Twins::new(&self.device, &self.plan, &self.arena, buffers)?);
        }
        Ok(self)
    }

    /// Submits the whole plan and returns at once. What comes next waits for it: [`Run::finish`], a write, another run.
    ///
    /// # Errors
    /// As [`Run::execute`].
    pub fn start(&mut self) -> Result<()> {
        self.settle()?;
        self.check_inputs()?;
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
            self.wait(self.signalled)?;
        }
        if self.under_way {
            self.under_way = false;
            self.forget_inputs();
        }
        Ok(())
    }
}
