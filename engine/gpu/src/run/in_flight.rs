use crate::{Result, Run, memory::staging::StagingBuffers};

impl Run {
    /// Prepares for [`Run::start`]. Adds staging buffers unless device memory is host visible.
    ///
    /// # Errors
    /// [`crate::Error::Memory`] without host memory for them.
    pub fn in_flight(mut self) -> Result<Self> {
        self.overlapped = true;
        self.make_staging()?;
        Ok(self)
    }

    pub(crate) fn make_staging(&mut self) -> Result<()> {
        let arena = self.lane.memory();
        if let Some(staging) = self.staging.take() {
            // SAFETY: the lane is settled, so neither is in flight.
            unsafe { self.device.0.raw.free_command_buffers(self.pool, &[staging.upload, staging.download]) };
        }
        if self.overlapped && !arena.is_host_visible() {
            let buffers = [self.command_buffer()?, self.command_buffer()?];
            self.staging = Some(StagingBuffers::new(&self.device, &self.plan, &arena, buffers)?);
        }
        Ok(())
    }

    /// Submits the plan without waiting. [`Run::finish`], writes and other runs of the lane wait
    /// for it.
    pub fn start(&mut self) -> Result<()> {
        self.begin()?;
        self.encode_all()?;
        self.in_flight = true;
        let (upload, download) = self.staging.as_ref().map(|staging| (staging.upload, staging.download)).unzip();
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

    pub(crate) fn settle(&mut self) -> Result<()> {
        if self.in_flight || self.presenting.is_some() {
            self.lane.wait(self.signalled)?;
        }
        if self.in_flight {
            self.in_flight = false;
            self.forget_inputs();
        }
        Ok(())
    }
}
