//! Plan execution in submissions short enough for driver watchdogs.

mod bind;
mod bindings;
mod commands;
mod descriptors;
mod in_flight;
mod present;
mod profile;
mod schedule;
mod times;

pub use present::{ImagePlace, Point, Target};
pub use profile::{Profile, ProfileRow};
pub use times::StageTimes;

use self::{
    bindings::Bindings,
    commands::Encoder,
    descriptors::Descriptors,
    present::submit_info,
    schedule::{Cursor, Piece, SUBMISSION, first_guess, learned},
};
use crate::{
    Device, Error, Plan, Resident, Result, Tensor,
    device::failure::{driver, is_in_flight},
    lock::lock,
    memory::{
        Memory,
        arena::{Arena, Lane},
        staging::StagingBuffers,
    },
    plan::{Command, Role},
};
use ash::vk::{self, Handle};
use bytemuck::Pod;
use std::{
    collections::VecDeque,
    ops::ControlFlow,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

const IN_FLIGHT: usize = 2;

/// Progress of a run.
#[derive(Clone, Copy, Debug)]
pub struct Progress<'a> {
    /// Completed fraction, 0 to 1.
    pub fraction: f64,
    /// Current scope.
    pub scope: &'a str,
}

/// A plan bound to a device. Executions replay the encoded commands.
pub struct Run {
    device: Device,
    plan: Plan,
    id: u64,
    lane: Arc<Lane>,
    generation: u64,
    staging: Option<StagingBuffers>,
    overlapped: bool,
    residents: Vec<Arc<Resident>>,
    descriptors: Descriptors,
    pool: vk::CommandPool,
    signalled: u64,
    batches: Vec<Batch>,
    /// End of the batches.
    encoded: Cursor,
    written: Vec<bool>,
    in_flight: bool,
    presenting: Option<vk::CommandBuffer>,
}

struct Batch {
    pub commands: vk::CommandBuffer,
    cost: u64,
    first_command: usize,
}

struct Clock {
    times: StageTimes,
    last: Instant,
    done: u64,
}

impl Run {
    /// Allocates a plan's arena, before any submission.
    pub fn new(device: &Device, plan: Plan) -> Result<Self> {
        Self::with_resident(device, plan, [])
    }

    /// As [`Run::new`], for a plan with tensors of these residents.
    pub fn with_resident(
        device: &Device,
        plan: Plan,
        residents: impl IntoIterator<Item = Arc<Resident>>,
    ) -> Result<Self> {
        Self::in_lane(device, Lane::new(device)?, plan, residents.into_iter().collect())
    }

    /// As [`Run::with_resident`], in a lane of an arena. Its other runs invalidate inputs and
    /// outputs.
    ///
    /// # Panics
    /// If the plan has constants, which other runs would overwrite.
    pub fn in_arena(
        arena: &Arena,
        lane: usize,
        plan: Plan,
        residents: impl IntoIterator<Item = Arc<Resident>>,
    ) -> Result<Self> {
        assert!(plan.allocations.iter().all(|a| a.role != Role::Constant), "a constant in shared memory");
        Self::in_lane(arena.device(), arena.lane(lane)?, plan, residents.into_iter().collect())
    }

    fn in_lane(device: &Device, lane: Arc<Lane>, mut plan: Plan, residents: Vec<Arc<Resident>>) -> Result<Self> {
        if residents.iter().any(|resident| !resident.is_on(device)) {
            return Err(Error::argument("memory of a run", "another device's", "this device's"));
        }
        if device.0.instance.debug.is_some() {
            plan.poison();
        }
        let generation = lane.reserve(&plan.blocks)?;
        let arena = lane.memory();
        let bound = Bindings { shared: &device.0, plan: &plan, arena: &arena, residents: &residents };
        let descriptors = Descriptors::new(device, &bound)?;
        let raw = &device.0.raw;
        let pool_info = vk::CommandPoolCreateInfo::default()
            .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER)
            .queue_family_index(device.0.family);
        // SAFETY: a valid create info; destroyed in `drop`.
        let pool =
            unsafe { raw.create_command_pool(&pool_info, None) }.map_err(|e| driver("vkCreateCommandPool", e))?;
        static RUNS: AtomicU64 = AtomicU64::new(1);
        let written = vec![false; plan.allocations.len()];
        Ok(Self {
            device: device.clone(),
            plan,
            id: RUNS.fetch_add(1, Ordering::Relaxed),
            lane,
            generation,
            staging: None,
            overlapped: false,
            residents,
            descriptors,
            pool,
            signalled: 0,
            batches: Vec::new(),
            encoded: Cursor::default(),
            written,
            in_flight: false,
            presenting: None,
        })
    }

    /// Returns the plan.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Writes a tensor of this plan from its start.
    ///
    /// # Panics
    /// For data longer than the tensor.
    pub fn write<T: Pod>(&mut self, tensor: Tensor, data: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        assert!(bytes.len() as u64 <= tensor.bytes, "{} bytes into {}", bytes.len(), tensor.bytes);
        self.bind()?;
        let id = tensor.allocation();
        self.written[id] = true;
        if let Some((memory, offset)) = self.staging.as_ref().and_then(|staging| staging.place(id)) {
            return memory.write(0, offset + tensor.offset, bytes);
        }
        let place = self.plan.placements[id];
        self.lane.memory().write(place.block, place.offset + tensor.offset, bytes)
    }

    /// Reads an output.
    ///
    /// # Panics
    /// If the tensor is no output, the run is in flight or another used the lane.
    pub fn read<T: Pod>(&self, tensor: Tensor) -> Result<Vec<T>> {
        let id = tensor.allocation();
        assert!(!self.in_flight, "read before finish");
        assert!(self.plan.allocations[id].output, "{} is not an output", self.plan.allocations[id].name);
        assert!(self.lane.holds(self.id), "read after another run of the lane");
        let place = self.plan.placements[id];
        let mut data = vec![T::zeroed(); tensor.bytes as usize / size_of::<T>()];
        let bytes = bytemuck::cast_slice_mut(&mut data);
        match self.staging.as_ref().and_then(|staging| staging.place(id)) {
            Some((memory, offset)) => memory.read(0, offset + tensor.offset, bytes)?,
            None => self.lane.memory().read(place.block, place.offset + tensor.offset, bytes)?,
        }
        Ok(data)
    }

    /// Returns the observed tensors in order.
    pub fn observed(&self) -> &[(String, Tensor)] {
        &self.plan.observed
    }

    /// Runs the plan.
    ///
    /// # Errors
    /// [`Error::DeviceLost`], a driver error, or validation messages.
    pub fn execute(&mut self) -> Result<StageTimes> {
        self.execute_with(|_| ControlFlow::Continue(()))
    }

    /// As [`Run::execute`]; `progress`, called between submissions, may stop the run.
    pub fn execute_with(&mut self, mut progress: impl FnMut(Progress<'_>) -> ControlFlow<()>) -> Result<StageTimes> {
        self.begin()?;
        // Set before a panic in `progress` can unwind.
        self.in_flight = true;
        let result = self.submit_all(&mut progress);
        // Submissions end before their resources change.
        let idle = self.lane.wait(self.signalled);
        self.in_flight = false;
        self.forget_inputs();
        if result.is_err() {
            // An incomplete recording must not be replayed.
            self.discard_batches();
        }
        let times = result?;
        idle?;
        self.device.0.check_messages()?;
        Ok(times)
    }

    fn submit_all(&mut self, progress: &mut dyn FnMut(Progress<'_>) -> ControlFlow<()>) -> Result<StageTimes> {
        let total: u64 = self.plan.commands.iter().map(Command::cost).sum();
        let mut clock = Clock { times: StageTimes::default(), last: Instant::now(), done: 0 };
        let mut in_flight = VecDeque::new();
        if let Some(upload) = self.staging.as_ref().map(|staging| staging.upload) {
            self.submit(upload)?;
        }
        for index in 0.. {
            if index == self.batches.len() {
                self.encode_next()?;
            }
            let Some(batch) = self.batches.get(index) else { break };
            let (buffer, first) = (batch.commands, batch.first_command);
            in_flight.push_back((self.submit(buffer)?, index, Instant::now()));
            if in_flight.len() == IN_FLIGHT {
                self.finish_one(&mut in_flight, &mut clock)?;
            }
            let scope = &self.plan.scopes[self.plan.commands[first].scope as usize];
            if progress(Progress { fraction: clock.done as f64 / total.max(1) as f64, scope }).is_break() {
                return Err(Error::Cancelled);
            }
        }
        while !in_flight.is_empty() {
            self.finish_one(&mut in_flight, &mut clock)?;
        }
        if let Some(download) = self.staging.as_ref().map(|staging| staging.download) {
            self.submit(download)?;
        }
        Ok(clock.times)
    }

    fn finish_one(&self, in_flight: &mut VecDeque<(u64, usize, Instant)>, clock: &mut Clock) -> Result<()> {
        let Some((value, index, submitted)) = in_flight.pop_front() else { return Ok(()) };
        let late = self.lane.value()? >= value;
        self.lane.wait(value)?;
        let (took, batch) = (clock.last.elapsed(), &self.batches[index]);
        self.learn(batch, submitted.max(clock.last).elapsed(), late);
        clock.last = Instant::now();
        clock.done += batch.cost;
        clock.times.add(self.plan.stage(batch.first_command), took);
        Ok(())
    }

    fn encode_all(&mut self) -> Result<()> {
        while self.encoded.command < self.plan.commands.len() {
            if let Err(error) = self.encode_next() {
                self.discard_batches();
                return Err(error);
            }
        }
        Ok(())
    }

    fn encode_next(&mut self) -> Result<()> {
        if self.encoded.command < self.plan.commands.len() {
            let mut cursor = self.encoded;
            let batch = self.encode(&mut cursor)?;
            self.batches.push(batch);
            self.encoded = cursor;
        }
        Ok(())
    }

    fn bound<'a>(&'a self, arena: &'a Memory) -> Bindings<'a> {
        Bindings { shared: &self.device.0, plan: &self.plan, arena, residents: &self.residents }
    }

    fn encode(&self, cursor: &mut Cursor) -> Result<Batch> {
        let first_command = cursor.command;
        let (pieces, cost) = cursor.next_pieces(&self.plan, self.budget(first_command));
        let commands = self.command_buffer()?;
        match self.record(commands, &pieces, None) {
            Ok(()) => Ok(Batch { commands, cost, first_command }),
            Err(error) => {
                // SAFETY: it was never submitted.
                unsafe { self.device.0.raw.free_command_buffers(self.pool, &[commands]) };
                Err(error)
            }
        }
    }

    fn record(
        &self,
        commands: vk::CommandBuffer,
        pieces: &[Piece],
        queries: Option<(vk::QueryPool, u32)>,
    ) -> Result<()> {
        let arena = self.lane.memory();
        let bound = self.bound(&arena);
        let mut encoder = Encoder::begin(&bound, &self.descriptors, commands, queries)?;
        for piece in pieces {
            encoder.piece(*piece)?;
        }
        encoder.end()
    }

    fn submit(&mut self, commands: vk::CommandBuffer) -> Result<u64> {
        self.device.0.check_lost()?;
        self.submit_between(commands, &[], &[])
    }

    /// Submits between semaphore values; returns the timeline's value at the end.
    fn submit_between(&mut self, commands: vk::CommandBuffer, waits: &[Point], signals: &[Point]) -> Result<u64> {
        let value = self.lane.next_value()?;
        let own = Point { semaphore: self.lane.timeline.as_raw(), value };
        let infos = |points: &[Point]| points.iter().map(submit_info).collect::<Vec<_>>();
        let (waits, signals) = (infos(waits), infos(&[signals, &[own]].concat()));
        let buffers = [vk::CommandBufferSubmitInfo::default().command_buffer(commands)];
        let info = vk::SubmitInfo2::default()
            .command_buffer_infos(&buffers)
            .wait_semaphore_infos(&waits)
            .signal_semaphore_infos(&signals);
        // SAFETY: recorded and not in flight; the creator of a target vouches for its semaphores.
        let submitted = unsafe { self.device.0.queue.submit(&self.device.0.raw, info, vk::Fence::null()) }
            .map_err(|e| self.device.0.failed("vkQueueSubmit2", e));
        self.lane.submitted(value, &submitted);
        if is_in_flight(&submitted) {
            self.signalled = value;
        }
        submitted.map(|()| value)
    }

    fn command_buffer(&self) -> Result<vk::CommandBuffer> {
        let info = vk::CommandBufferAllocateInfo::default().command_pool(self.pool).command_buffer_count(1);
        // SAFETY: only this run uses the pool, from one thread at a time.
        unsafe { self.device.0.raw.allocate_command_buffers(&info) }
            .map(|buffers| buffers[0])
            .map_err(|e| driver("vkAllocateCommandBuffers", e))
    }

    fn budget(&self, command: usize) -> u64 {
        self.speed(self.plan.stage(command)) * SUBMISSION.as_millis() as u64
    }

    fn speed(&self, stage: &str) -> u64 {
        let known = lock(&self.device.0.flops_per_ms).get(stage).copied();
        known.unwrap_or_else(|| first_guess(self.device.limits()))
    }

    fn learn(&self, batch: &Batch, took: Duration, late: bool) {
        let stage = self.plan.stage(batch.first_command);
        let next = learned(self.speed(stage), batch.cost, took, late, self.device.limits().cpu);
        lock(&self.device.0.flops_per_ms).insert(stage.to_owned(), next);
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        // Fails only if the device is lost; nothing is in flight then.
        let _ = self.settle();
        let raw = &self.device.0.raw;
        // SAFETY: nothing is in flight.
        unsafe { raw.destroy_command_pool(self.pool, None) };
    }
}
