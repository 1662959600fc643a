//! Keeping a run bound to memory that may be replaced: by a larger one of its lane, or by another of the same layout.

use super::Run;
use crate::{Error, Resident, Result, descriptors::Descriptors, plan::Role};
use std::sync::Arc;

/// The generation of no memory: what was encoded has to be encoded again.
const STALE: u64 = u64::MAX;

impl Run {
    /// Runs from now on with another memory of the same layout.
    ///
    /// # Panics
    /// Where the run has no memory of that layout.
    pub fn replace_resident(&mut self, resident: Arc<Resident>) {
        let own = self.residents.iter_mut().find(|own| own.layout == resident.layout).expect("a memory of that layout");
        if !Arc::ptr_eq(own, &resident) {
            *own = resident;
            self.generation = STALE;
        }
    }

    /// Makes the lane ready for this run: room for its arena, nothing under way, no bytes of others.
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

    /// Descriptors, and later commands, for the memory that there is now.
    fn rebind(&mut self) -> Result<()> {
        self.settle()?;
        self.discard_batches();
        let arena = self.lane.memory();
        self.descriptors = Descriptors::new(&self.device, &self.bound(&arena))?;
        drop(arena);
        self.make_twins()
    }

    /// Records what comes before every submission of the plan.
    pub(crate) fn begin(&mut self) -> Result<()> {
        self.bind()?;
        self.check_inputs()
    }

    pub(super) fn discard_batches(&mut self) {
        let commands: Vec<_> = self.batches.drain(..).map(|b| b.commands).collect();
        if !commands.is_empty() {
            // SAFETY: the caller waited for what was submitted.
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

    /// Later tensors may share an input's bytes, so it has to be written again.
    pub(crate) fn forget_inputs(&mut self) {
        for (allocation, written) in self.plan.allocations.iter().zip(&mut self.written) {
            *written &= allocation.role == Role::Constant;
        }
    }
}
