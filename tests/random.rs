//! Reproducible random numbers.

/// Returns `len` values in (-1, 1) from a seed (splitmix64).
pub fn random(seed: u64, len: usize) -> Vec<f32> {
    let signed = |z: u64| (z >> 40) as f32 / (1 << 23) as f32 - 1.0;
    (0..len).map(|i| signed(bits(seed, i))).collect()
}

/// Returns `len` integers below `bound` from a seed.
pub fn random_below(seed: u64, len: usize, bound: u32) -> Vec<u32> {
    (0..len).map(|i| (bits(seed, i) >> 32) as u32 % bound).collect()
}

fn bits(seed: u64, i: usize) -> u64 {
    let z = (seed << 32).wrapping_add(i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
