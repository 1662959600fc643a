//! Random numbers by seed, stream and counter.

use zipsplat::random::Random;

pub(super) struct Rng(Random);

impl Rng {
    pub fn new(seed: u64, stream: u64) -> Self {
        Self(Random::stream(seed, stream))
    }

    pub fn bits(&mut self) -> u64 {
        self.0.bits()
    }

    pub fn unit(&mut self) -> f32 {
        self.range(0.0, 1.0)
    }

    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        self.0.uniform(low, high)
    }

    /// Log-uniform in [low, high), both positive.
    pub fn scale(&mut self, low: f32, high: f32) -> f32 {
        low * (high / low).powf(self.unit())
    }

    pub fn signed(&mut self) -> f32 {
        self.range(-1.0, 1.0)
    }

    pub fn angle(&mut self) -> f32 {
        std::f32::consts::PI * self.signed()
    }

    pub fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    pub fn count(&mut self, low: usize, high: usize) -> usize {
        low + self.bits() as usize % (high - low + 1)
    }

    pub fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.bits() as usize % choices.len()]
    }
}
