/// Whether Gaussian `i` is hidden: its hash, by PCG's RXS M XS permutation, is below `least`.
pub fn is_hidden(i: u32, key: u32, least: u32) -> bool {
    let state = (key ^ i).wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = ((state >> ((state >> 28) + 4)) ^ state).wrapping_mul(277_803_737);
    ((word >> 22) ^ word) < least
}
