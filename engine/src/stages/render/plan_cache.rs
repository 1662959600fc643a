use super::FrameShape;
use crate::{Error, Result, gpu::Limits};

/// Default limit of plans.
const PLANS: usize = 4;

#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PlanKey<K> {
    pub shape: FrameShape,
    pub backward: bool,
    pub options: K,
}

/// Recently used plans, with more capacity after an overflow.
pub(crate) struct PlanCache<K, P> {
    /// Least recently used first.
    entries: Vec<Entry<K, P>>,
    most: usize,
    max_binding_bytes: u64,
    /// Intersections per camera of new plans; grows on demand.
    pub capacity: usize,
}

struct Entry<K, P> {
    key: PlanKey<K>,
    capacity: usize,
    plan: P,
}

impl<K: Copy + PartialEq, P> PlanCache<K, P> {
    pub fn new(limits: &Limits, capacity: usize) -> Self {
        Self { entries: Vec::new(), most: PLANS, max_binding_bytes: limits.max_binding_bytes, capacity }
    }

    pub fn holding(self, most: usize) -> Self {
        Self { most, ..self }
    }

    pub fn clear(&mut self) {
        self.entries.clear();
    }

    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut P> {
        self.entries.iter_mut().map(|entry| &mut entry.plan)
    }

    /// Returns the plan of `key`; `record` records a missing one.
    pub fn get(&mut self, key: PlanKey<K>, record: impl FnOnce(usize) -> Result<P>) -> Result<&mut P> {
        let entry = match self.entries.iter().position(|entry| entry.key == key) {
            Some(index) => self.entries.remove(index),
            None => {
                if self.entries.len() == self.most {
                    self.entries.remove(0);
                }
                let capacity = planned_capacity(self.max_binding_bytes, self.capacity, key.shape, key.backward);
                Entry { key, capacity, plan: record(capacity)? }
            }
        };
        self.entries.push(entry);
        Ok(&mut self.entries.last_mut().expect("just pushed").plan)
    }

    /// Runs and returns the plan of `key`, recorded with more capacity after each overflow. `run`
    /// returns the intersections.
    pub fn run(
        &mut self,
        key: PlanKey<K>,
        record: impl Fn(usize) -> Result<P>,
        mut run: impl FnMut(&mut P) -> Result<usize>,
    ) -> Result<&mut P> {
        loop {
            let needed = run(self.get(key, &record)?)?;
            if self.fitting(needed)?.is_some() {
                break;
            }
        }
        Ok(&mut self.entries.last_mut().expect("it fits").plan)
    }

    /// Returns the last used plan if `needed` intersections fit. Otherwise the next one is larger;
    /// [`Error::Memory`] if none can be.
    pub fn fitting(&mut self, needed: usize) -> Result<Option<&mut P>> {
        if let Some(Entry { key, .. }) = self.entries.pop_if(|entry| needed > entry.capacity) {
            let (needed_bytes, available) = (needed as u64 * intersection_bytes(key.backward), self.max_binding_bytes);
            if needed_bytes > available {
                let what = "a list of the intersections of Gaussians with tiles".into();
                return Err(Error::Memory { what, needed: needed_bytes, available });
            }
            // Headroom for small camera movements.
            self.capacity = self.capacity.max((needed + needed / 4).div_ceil(key.shape.cameras));
            return Ok(None);
        }
        Ok(self.entries.last_mut().map(|entry| &mut entry.plan))
    }
}

/// A few tiles per Gaussian.
pub fn first_capacity(gaussians: usize) -> usize {
    (4 * gaussians).max(1 << 16)
}

/// `each` per camera, as far as its tensors can be bound.
pub(crate) fn planned_capacity(max_binding_bytes: u64, each: usize, shape: FrameShape, backward: bool) -> usize {
    each.saturating_mul(shape.cameras).min((max_binding_bytes / intersection_bytes(backward)) as usize)
}

/// Bytes per intersection in the largest tensor, the six moments of a backward pass.
fn intersection_bytes(backward: bool) -> u64 {
    if backward { 24 } else { 4 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(cameras: usize, options: u32) -> PlanKey<u32> {
        PlanKey { shape: FrameShape { cameras, width: 8, height: 8 }, backward: false, options }
    }

    fn cache(capacity: usize) -> PlanCache<u32, usize> {
        PlanCache::new(&Limits { max_binding_bytes: 4000, ..Limits::default() }, capacity)
    }

    #[test]
    fn least_recently_used_plan_is_dropped() {
        let (mut cache, mut recorded) = (cache(1).holding(3), Vec::new());
        for options in [0, 1, 2, 0, 3, 0, 1] {
            let record = |capacity| {
                recorded.push(options);
                Ok(capacity)
            };
            cache.get(key(1, options), record).unwrap();
        }
        assert_eq!(recorded, [0, 1, 2, 3, 1]);
        assert!(cache.get(key(1, 5), |_| Err(Error::Cancelled)).is_err());
        cache.get(key(1, 1), |_| panic!("cached before")).unwrap();
    }

    #[test]
    fn capacity_grows_until_no_plan_can_hold_it() {
        let mut cache = cache(10);
        assert_eq!(*cache.get(key(2, 0), Ok).unwrap(), 20);
        assert!(cache.fitting(20).unwrap().is_some());
        assert!(cache.fitting(21).unwrap().is_none() && cache.entries.is_empty());
        assert_eq!((cache.capacity, *cache.get(key(2, 0), Ok).unwrap()), (13, 26));
        assert!(cache.fitting(1000).unwrap().is_none());
        assert_eq!(*cache.get(key(2, 0), Ok).unwrap(), 1000);
        let error = cache.fitting(1001).unwrap_err().to_string();
        assert!(error.ends_with("tiles needs 4004 bytes, 4000 bytes are there"), "{error}");
    }
}
