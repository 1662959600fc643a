//! One memory for plans that take turns.

use super::{
    Device, Plan,
    failure::{driver, is_under_way},
    lock::lock,
    memory::Memory,
};
use crate::Result;
use ash::vk;
use std::sync::{
    Arc, Mutex,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

/// Scratch memory that plans share which never run at the same time. Each plan of a lane begins at the lane's first byte, so a
/// lane is as large as the largest of its plans, not as their sum. Cloning shares the memory.
#[derive(Clone)]
pub struct Arena(Arc<Lanes>);

struct Lanes {
    device: Device,
    lanes: [Mutex<Option<Arc<Lane>>>; Arena::LANES],
    claimed: AtomicBool,
}

/// The right to run plans in an arena, which nobody else has until it is dropped.
pub struct Claim(Arena);

impl Arena {
    /// Lanes: plans that may be under way at the same time, such as two pictures in flight.
    pub const LANES: usize = 2;

    /// An arena without memory: it grows with the plans that run in it.
    pub fn new(device: &Device) -> Self {
        let (device, lanes, claimed) = (device.clone(), Default::default(), AtomicBool::new(false));
        Self(Arc::new(Lanes { device, lanes, claimed }))
    }

    /// Bytes of a lane that these plans take turns in.
    pub fn lane_bytes<'a>(plans: impl IntoIterator<Item = &'a Plan>) -> u64 {
        plans.into_iter().fold(Vec::new(), |sizes, plan| grown(&sizes, plan.block_bytes())).iter().sum()
    }

    /// The device that the memory is on.
    pub fn device(&self) -> &Device {
        &self.0.device
    }

    /// True where both arenas are the same memory.
    pub fn is(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }

    /// The right to run plans here; `None` while somebody else has it.
    pub fn claim(&self) -> Option<Claim> {
        let free = self.0.claimed.compare_exchange(false, true, Ordering::Acquire, Ordering::Relaxed);
        free.is_ok().then(|| Claim(self.clone()))
    }

    /// The arena and the right to run plans in it, or another one where somebody has that right now.
    pub fn claimed(&self) -> (Self, Option<Claim>) {
        match self.claim() {
            Some(claim) => (self.clone(), Some(claim)),
            None => (Self::new(self.device()), None),
        }
    }

    /// Bytes of all lanes.
    pub fn bytes(&self) -> u64 {
        let bytes = |lane: &Arc<Lane>| lock(&lane.state).sizes.iter().sum::<u64>();
        self.0.lanes.iter().map(|lane| lock(lane).as_ref().map_or(0, bytes)).sum()
    }

    /// Gives the memory back; for whoever has the claim. Plans take theirs anew when they run again.
    ///
    /// # Errors
    /// [`Error::DeviceLost`](crate::Error::DeviceLost).
    pub fn release(&self) -> Result<()> {
        self.0.lanes.iter().try_for_each(|lane| lock(lane).as_ref().map_or(Ok(()), |lane| lane.release()))
    }

    /// A lane, made when it is first asked for.
    pub(super) fn lane(&self, lane: usize) -> Result<Arc<Lane>> {
        let mut lane = lock(&self.0.lanes[lane]);
        match &*lane {
            Some(made) => Ok(made.clone()),
            None => Ok(lane.insert(Lane::new(&self.0.device)?).clone()),
        }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.0.0.claimed.store(false, Ordering::Release);
    }
}

/// The memory of one plan at a time, and the timeline of what is submitted for it.
pub(super) struct Lane {
    device: Device,
    timeline: vk::Semaphore,
    /// The timeline's value behind everything that was submitted.
    signalled: AtomicU64,
    /// The largest value that was waited for.
    waited: AtomicU64,
    state: Mutex<State>,
}

struct State {
    memory: Arc<Memory>,
    /// Bytes of each block.
    sizes: Vec<u64>,
    /// Counts the memories that there were.
    generation: u64,
    /// The run that used the lane last.
    user: u64,
}

impl Lane {
    pub fn new(device: &Device) -> Result<Arc<Self>> {
        let memory = Arc::new(Memory::new(device, "arena", &[])?);
        let mut kind = vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
        let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
        // SAFETY: a valid create info; destroyed in `drop`.
        let timeline =
            unsafe { device.0.raw.create_semaphore(&info, None) }.map_err(|e| driver("vkCreateSemaphore", e))?;
        let state = Mutex::new(State { memory, sizes: Vec::new(), generation: 0, user: 0 });
        Ok(Arc::new(Self {
            device: device.clone(),
            timeline,
            signalled: AtomicU64::new(0),
            waited: AtomicU64::new(0),
            state,
        }))
    }

    /// Makes room for a plan's blocks, once everything that was submitted here is done. Returns the memory's generation.
    ///
    /// # Errors
    /// [`Error::Memory`](crate::Error::Memory) where the device has too little; what the lane had is given back then.
    pub fn reserve(&self, blocks: &[u64]) -> Result<u64> {
        self.settle()?;
        let mut state = lock(&self.state);
        let fits =
            blocks.len() <= state.sizes.len() && blocks.iter().zip(&state.sizes).all(|(need, have)| need <= have);
        if !fits {
            let grown = grown(&state.sizes, blocks);
            // Given back before as much and more is taken.
            state.empty(&self.device)?;
            let memory = |sizes: &[u64]| Memory::new(&self.device, "arena", sizes);
            let (memory, sizes) = match memory(&grown) {
                Err(crate::Error::Memory { .. }) if grown != blocks => (memory(blocks)?, blocks.to_vec()),
                found => (found?, grown),
            };
            (state.memory, state.sizes) = (Arc::new(memory), sizes);
        }
        Ok(state.generation)
    }

    fn release(&self) -> Result<()> {
        self.settle()?;
        lock(&self.state).empty(&self.device)
    }

    /// The memory, for as long as one call takes: whoever keeps it keeps it from being given back.
    pub fn memory(&self) -> Arc<Memory> {
        lock(&self.state).memory.clone()
    }

    /// Notes that a run uses the lane; false where another one did in between, which left nothing of its inputs and results.
    pub fn used_by(&self, run: u64) -> bool {
        std::mem::replace(&mut lock(&self.state).user, run) == run
    }

    /// True where this run used the lane last: inputs and results in it are its own.
    pub fn holds(&self, run: u64) -> bool {
        lock(&self.state).user == run
    }

    /// The timeline, for a submission that is to signal [`Lane::next_value`].
    pub fn timeline(&self) -> vk::Semaphore {
        self.timeline
    }

    /// A value that the timeline did not have yet.
    pub fn next_value(&self) -> Result<u64> {
        Ok(self.value()?.max(self.signalled.load(Ordering::Relaxed)) + 1)
    }

    /// Books a submission that signals `value`, where it is under way.
    pub fn submitted(&self, value: u64, result: &Result<()>) {
        if is_under_way(result) {
            self.signalled.fetch_max(value, Ordering::Relaxed);
        }
    }

    /// The timeline's value now.
    pub fn value(&self) -> Result<u64> {
        // SAFETY: the semaphore is alive.
        unsafe { self.device.0.raw.get_semaphore_counter_value(self.timeline) }
            .map_err(|e| self.device.0.failed("vkGetSemaphoreCounterValue", e))
    }

    /// Waits until the timeline has a value that was submitted for signalling.
    pub fn wait(&self, value: u64) -> Result<()> {
        let (semaphores, values) = ([self.timeline], [value]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is alive.
        unsafe { self.device.0.raw.wait_semaphores(&info, u64::MAX) }
            .map_err(|e| self.device.0.failed("vkWaitSemaphores", e))?;
        // A wait on a lost device may end with success all the same.
        self.device.0.check_lost()?;
        self.waited.fetch_max(value, Ordering::Relaxed);
        Ok(())
    }

    /// Waits for everything that was submitted here.
    pub fn settle(&self) -> Result<()> {
        let last = self.signalled.load(Ordering::Relaxed);
        if last > self.waited.load(Ordering::Relaxed) { self.wait(last) } else { Ok(()) }
    }
}

/// Blocks that hold either.
fn grown(sizes: &[u64], blocks: &[u64]) -> Vec<u64> {
    let bytes = |of: &[u64], i: usize| of.get(i).copied().unwrap_or(0);
    (0..sizes.len().max(blocks.len())).map(|i| bytes(sizes, i).max(bytes(blocks, i))).collect()
}

impl State {
    fn empty(&mut self, device: &Device) -> Result<()> {
        self.memory = Arc::new(Memory::new(device, "arena", &[])?);
        self.sizes.clear();
        self.generation += 1;
        Ok(())
    }
}

impl Drop for Lane {
    fn drop(&mut self) {
        // Fails only where the device is lost: then nothing is under way.
        let _ = self.settle();
        // SAFETY: nothing is under way.
        unsafe { self.device.0.raw.destroy_semaphore(self.timeline, None) };
    }
}
