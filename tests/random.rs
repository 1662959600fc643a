use zipsplat::random::Random;

/// Returns `len` values in (-1, 1) from a seed (splitmix64).
pub fn random(seed: u64, len: usize) -> Vec<f32> {
    let signed = |z: u64| (z >> 40) as f32 / (1 << 23) as f32 - 1.0;
    (0..len).map(|i| signed(bits(seed, i))).collect()
}

pub fn random_below(seed: u64, len: usize, bound: u32) -> Vec<u32> {
    (0..len).map(|i| (bits(seed, i) >> 32) as u32 % bound).collect()
}

fn bits(seed: u64, i: usize) -> u64 {
    Random::nth(0, (seed << 32).wrapping_add(i as u64))
}
