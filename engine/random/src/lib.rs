//! Seeded random numbers, the same on every machine.

use std::f64::consts::TAU;

const INCREMENT: u64 = 0x9e37_79b9_7f4a_7c15;

/// SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// Creates a generator.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Creates an independent stream of a seed.
    pub fn stream(seed: u64, stream: u64) -> Self {
        Self(mix(Self::nth(seed, 0).wrapping_add(stream.wrapping_mul(INCREMENT))))
    }

    /// Returns the state, to be kept or set.
    pub fn state(&mut self) -> &mut u64 {
        &mut self.0
    }

    /// Returns number `i` of a seed.
    pub fn nth(seed: u64, i: u64) -> u64 {
        mix(seed.wrapping_add(i.wrapping_add(1).wrapping_mul(INCREMENT)))
    }

    /// Returns 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(INCREMENT);
        mix(self.0)
    }

    /// Uniform below `count`.
    pub fn below(&mut self, count: usize) -> usize {
        ((u128::from(self.bits()) * count as u128) >> 64) as usize
    }

    /// Uniform in 0..1.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in `low..high`, in steps of 2^-24 of the width.
    pub fn uniform(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * ((self.bits() >> 40) as f32 / (1 << 24) as f32)
    }

    /// Standard normal (Box and Muller 1958).
    pub fn normal(&mut self) -> f64 {
        let (radius, angle) = ((-2.0 * (1.0 - self.unit()).ln()).sqrt(), TAU * self.unit());
        radius * angle.cos()
    }
}

/// Hashes 64 bits bijectively.
pub fn mix(state: u64) -> u64 {
    let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_the_published_generator() {
        let numbers = [6457827717110365317, 3203168211198807973, 9817491932198370423];
        let mut random = Random::new(1234567);
        assert_eq!([(); 3].map(|()| random.bits()), numbers);
        assert_eq!([0, 1, 2].map(|i| Random::nth(1234567, i)), numbers);
    }

    #[test]
    fn moments_are_those_of_the_distributions() {
        let mut random = Random::new(3);
        let numbers: Vec<f64> = (0..20_000).map(|_| random.normal()).collect();
        let mean = |power: i32| numbers.iter().map(|x| x.powi(power)).sum::<f64>() / numbers.len() as f64;
        assert!(mean(1).abs() < 0.03 && (mean(2) - 1.0).abs() < 0.05 && (mean(4) - 3.0).abs() < 0.3);
        let unit: f64 = (0..20_000).map(|_| random.unit()).sum::<f64>() / 20_000.0;
        assert!((unit - 0.5).abs() < 0.01 && (0..1000).all(|_| random.below(7) < 7));
    }
}
