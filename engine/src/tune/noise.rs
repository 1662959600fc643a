use crate::gpu::Element;

/// Distinct rows: the host is slow.
const DISTINCT: usize = 1024;

/// Random numbers in (-1, 1), exact in `factor`. 8-bit ones survive row quantization.
pub(super) fn noise(seed: u64, rows: usize, width: usize, factor: Element) -> Vec<f32> {
    repeated(distinct(seed, rows, width, factor), rows)
}

pub(super) fn encoded_noise(seed: u64, rows: usize, width: usize, factor: Element, stored: Element) -> Vec<u8> {
    repeated(stored.encode(&distinct(seed, rows, width, factor)), rows)
}

fn distinct(seed: u64, rows: usize, width: usize, factor: Element) -> Vec<f32> {
    let mut state = seed << 40;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    let values: Vec<f32> = (0..rows.min(DISTINCT) * width).map(|_| next()).collect();
    match factor {
        Element::I8 => {
            let whole = |(i, x): (usize, f32)| if i % width == 0 { 127.0 } else { (126.0 * x).round() };
            values.into_iter().enumerate().map(|value| whole(value) / 128.0).collect()
        }
        _ => factor.decode(&factor.encode(&values)),
    }
}

fn repeated<T: Copy>(values: Vec<T>, rows: usize) -> Vec<T> {
    let len = values.len() / rows.min(DISTINCT) * rows;
    values.iter().copied().cycle().take(len).collect()
}
