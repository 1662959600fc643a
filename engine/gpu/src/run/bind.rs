use super::{descriptors::Descriptors, schedule::Cursor};
use crate::{Error, Resident, Result, Run, plan::Role};
use std::sync::Arc;

/// Forces encoding.
const STALE: u64 = u64::MAX;

impl Run {
    /// Replaces the resident of the same layout.
    ///
    /// # Panics
    /// If the run has none.
    pub fn replace_resident(&mut self, resident: Arc<Resident>) {
        let own = self.residents.iter_mut().find(|own| own.layout == resident.layout).expect("a memory of that layout");
        if !Arc::ptr_eq(own, &resident) {
            *own = resident;
            self.generation = STALE;
        }
    }

    /// Prepares the lane: idle, large enough, other runs' inputs invalidated.
    pub(super) fn bind(&mut self) -> Result<()> {
        self.settle()?;
        let generation = self.lane.reserve(&self.plan.blocks)?;
        if generation != self.generation {
            self.generation = STALE;
            self.rebind()?;
            self.generation = generation;
        }
        if !self.lane.used_by(self.id) {
            self.forget_inputs();
        }
        Ok(())
    }

    fn rebind(&mut self) -> Result<()> {
        self.settle()?;
        self.discard_batches();
        let arena = self.lane.memory();
        self.descriptors = Descriptors::new(&self.device, &self.bound(&arena))?;
        drop(arena);
        self.make_staging()
    }

    pub(crate) fn begin(&mut self) -> Result<()> {
        self.bind()?;
        self.check_inputs()
    }

    pub(super) fn discard_batches(&mut self) {
        self.encoded = Cursor::default();
        let commands: Vec<_> = self.batches.drain(..).map(|b| b.commands).collect();
        if !commands.is_empty() {
            // SAFETY: the caller waited for the submissions.
            unsafe { self.device.0.raw.free_command_buffers(self.pool, &commands) };
        }
    }

    fn check_inputs(&self) -> Result<()> {
        for (allocation, written) in self.plan.allocations.iter().zip(&self.written) {
            if allocation.role != Role::Scratch && !written && allocation.bytes > 0 {
                return Err(Error::argument(format!("input {}", allocation.name), "nothing", "a write before the run"));
            }
        }
        Ok(())
    }

    /// Invalidates inputs, whose bytes later tensors may share.
    pub(crate) fn forget_inputs(&mut self) {
        for (allocation, written) in self.plan.allocations.iter().zip(&mut self.written) {
            *written &= allocation.role == Role::Constant;
        }
    }
}
