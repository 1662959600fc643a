use super::Memory;
use crate::{
    Device, Plan, Result,
    device::failure::{driver, is_in_flight},
    lock::lock,
};
use ash::vk;
use std::sync::{
    Arc, Mutex,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

const WORKING: &str = "working memory on the device";

/// Scratch memory of plans that never run concurrently. A lane has the size of its largest plan.
#[derive(Clone)]
pub struct Arena(Arc<Lanes>);

struct Lanes {
    device: Device,
    lanes: [Mutex<Option<Arc<Lane>>>; Arena::LANES],
    claimed: AtomicBool,
}

/// Exclusive right to run plans in an arena, released on drop.
pub struct Claim(Arena);

impl Arena {
    /// Number of lanes, which may be in flight at the same time.
    pub const LANES: usize = 2;

    /// Creates an empty arena.
    pub fn new(device: &Device) -> Self {
        let (device, lanes, claimed) = (device.clone(), Default::default(), AtomicBool::new(false));
        Self(Arc::new(Lanes { device, lanes, claimed }))
    }

    /// Returns the bytes of a lane for these plans.
    pub fn lane_bytes<'a>(plans: impl IntoIterator<Item = &'a Plan>) -> u64 {
        plans.into_iter().fold(Vec::new(), |sizes, plan| grown(&sizes, plan.block_bytes())).iter().sum()
    }

    /// Returns the arena's device.
    pub fn device(&self) -> &Device {
        &self.0.device
    }

    /// Returns true if both arenas share their memory.
    pub fn is(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }

    /// Claims the arena, unless claimed.
    pub fn claim(&self) -> Option<Claim> {
        let free = self.0.claimed.compare_exchange(false, true, Ordering::Acquire, Ordering::Relaxed);
        free.is_ok().then(|| Claim(self.clone()))
    }

    /// Claims the arena, or a new one if it is claimed.
    pub fn claimed(&self) -> (Self, Option<Claim>) {
        match self.claim() {
            Some(claim) => (self.clone(), Some(claim)),
            None => (Self::new(self.device()), None),
        }
    }

    /// Returns the bytes of all lanes.
    pub fn bytes(&self) -> u64 {
        let bytes = |lane: &Arc<Lane>| lock(&lane.state).sizes.iter().sum::<u64>();
        self.0.lanes.iter().map(|lane| lock(lane).as_ref().map_or(0, bytes)).sum()
    }

    /// Frees the memory until the next run. The caller must hold the claim.
    pub fn release(&self) -> Result<()> {
        self.0.lanes.iter().try_for_each(|lane| lock(lane).as_ref().map_or(Ok(()), |lane| lane.release()))
    }

    pub(crate) fn lane(&self, lane: usize) -> Result<Arc<Lane>> {
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

pub(crate) struct Lane {
    device: Device,
    pub timeline: vk::Semaphore,
    signalled: AtomicU64,
    waited: AtomicU64,
    state: Mutex<State>,
}

struct State {
    memory: Arc<Memory>,
    sizes: Vec<u64>,
    generation: u64,
    user: u64,
}

impl Lane {
    pub fn new(device: &Device) -> Result<Arc<Self>> {
        let memory = Arc::new(Memory::new(device, WORKING, &[])?);
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

    pub fn reserve(&self, blocks: &[u64]) -> Result<u64> {
        self.settle()?;
        let mut state = lock(&self.state);
        let fits =
            blocks.len() <= state.sizes.len() && blocks.iter().zip(&state.sizes).all(|(need, have)| need <= have);
        if !fits {
            let grown = grown(&state.sizes, blocks);
            // Old and new memory never coexist.
            state.empty(&self.device)?;
            let memory = |sizes: &[u64]| Memory::new(&self.device, WORKING, sizes);
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

    /// A stored reference would keep it allocated.
    pub fn memory(&self) -> Arc<Memory> {
        lock(&self.state).memory.clone()
    }

    /// Returns false if another run may have overwritten its data.
    pub fn used_by(&self, run: u64) -> bool {
        std::mem::replace(&mut lock(&self.state).user, run) == run
    }

    pub fn holds(&self, run: u64) -> bool {
        lock(&self.state).user == run
    }

    pub fn next_value(&self) -> Result<u64> {
        Ok(self.value()?.max(self.signalled.load(Ordering::Relaxed)) + 1)
    }

    pub fn submitted(&self, value: u64, result: &Result<()>) {
        if is_in_flight(result) {
            self.signalled.fetch_max(value, Ordering::Relaxed);
        }
    }

    pub fn value(&self) -> Result<u64> {
        // SAFETY: the semaphore is alive.
        unsafe { self.device.0.raw.get_semaphore_counter_value(self.timeline) }
            .map_err(|e| self.device.0.failed("vkGetSemaphoreCounterValue", e))
    }

    pub fn wait(&self, value: u64) -> Result<()> {
        let (semaphores, values) = ([self.timeline], [value]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is alive.
        unsafe { self.device.0.raw.wait_semaphores(&info, u64::MAX) }
            .map_err(|e| self.device.0.failed("vkWaitSemaphores", e))?;
        // Waits on a lost device may return success.
        self.device.0.check_lost()?;
        self.waited.fetch_max(value, Ordering::Relaxed);
        Ok(())
    }

    pub fn settle(&self) -> Result<()> {
        let last = self.signalled.load(Ordering::Relaxed);
        if last > self.waited.load(Ordering::Relaxed) { self.wait(last) } else { Ok(()) }
    }
}

fn grown(sizes: &[u64], blocks: &[u64]) -> Vec<u64> {
    let bytes = |of: &[u64], i: usize| of.get(i).copied().unwrap_or(0);
    (0..sizes.len().max(blocks.len())).map(|i| bytes(sizes, i).max(bytes(blocks, i))).collect()
}

impl State {
    fn empty(&mut self, device: &Device) -> Result<()> {
        self.memory = Arc::new(Memory::new(device, WORKING, &[])?);
        self.sizes.clear();
        self.generation += 1;
        Ok(())
    }
}

impl Drop for Lane {
    fn drop(&mut self) {
        // Fails only on device loss; nothing is in flight then.
        let _ = self.settle();
        // SAFETY: nothing is in flight.
        unsafe { self.device.0.raw.destroy_semaphore(self.timeline, None) };
    }
}
