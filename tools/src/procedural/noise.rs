//! Lattice noise, faded below the pixel footprint.

use glam::{Vec2, Vec3A, Vec4, Vec4Swizzles};

pub(super) fn hash(x: i32, y: i32, z: i32) -> u32 {
    let mut word = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f);
    word = (word ^ (word >> 15)).wrapping_mul(0x2c1b_3c6d);
    word ^ (word >> 13)
}

/// Hashes to [0, 1).
pub(super) fn hash_unit(x: i32, y: i32, z: i32) -> f32 {
    (hash(x, y, z) >> 8) as f32 / (1 << 24) as f32
}

pub(super) fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Footprints, in features, where fading starts and ends.
const FADE: [f32; 2] = [0.3, 1.1];

/// Remaining contrast at footprint `width`.
pub(super) fn fade(width: f32) -> f32 {
    1.0 - smoothstep(FADE[0], FADE[1], width)
}

/// A power of two. Octaves with unrelated periods hide the repetition.
const SIDE: usize = 32;
/// 32 KiB fit in the L1 cache.
static LATTICE: [u8; SIDE * SIDE * SIDE] = lattice();

const fn lattice() -> [u8; SIDE * SIDE * SIDE] {
    let mut values = [0; SIDE * SIDE * SIDE];
    let (mut i, mut state) = (0, 0x2545_f491u32);
    while i < values.len() {
        // Xorshift (Marsaglia 2003).
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        values[i] = (state >> 24) as u8;
        i += 1;
    }
    values
}

/// Cubic interpolation, 0..1.
pub(super) fn value_noise(p: Vec3A) -> f32 {
    let floor = p.floor();
    let f = p - floor;
    let s = f * f * (3.0 - 2.0 * f);
    let wrap = |floor: f32| {
        let low = floor as i32 as usize % SIDE;
        [low, (low + 1) % SIDE]
    };
    let ([x0, x1], [y0, y1], [z0, z1]) = (wrap(floor.x), wrap(floor.y), wrap(floor.z));
    let rows = [(y0, z0), (y1, z0), (y0, z1), (y1, z1)].map(|(y, z)| (z * SIDE + y) * SIDE);
    let at = |x: usize| Vec4::from_array(rows.map(|row| f32::from(LATTICE[row + x])));
    let edges = at(x0).lerp(at(x1), s.x);
    let faces = edges.xz().lerp(edges.yw(), s.y);
    (faces.x + (faces.y - faces.x) * s.z) / 255.0
}

/// Octaves around 0.5, mostly in 0..1, except those below `width`.
pub(super) fn fbm(p: Vec3A, octaves: usize, width: f32) -> f32 {
    let (mut sum, mut weight, mut frequency) = (0.5, 0.5, 1.0);
    for octave in 0..octaves {
        let visible = if width * frequency < FADE[0] { 1.0 } else { fade(width * frequency) };
        if visible <= 0.0 {
            break;
        }
        // Decorrelates octaves.
        sum += weight * visible * (value_noise(p * frequency + 17.3 * octave as f32) - 0.5);
        frequency *= 2.03;
        weight *= 0.6;
    }
    sum
}

/// Approximate border distance and hash of a cell of jittered lattice points.
pub(super) fn voronoi(p: Vec2) -> (f32, u32) {
    let floor = p.floor();
    let (x, y) = (floor.x as i32, floor.y as i32);
    let (mut nearest, mut second, mut cell) = (f32::MAX, f32::MAX, 0);
    for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
        let word = hash(x + dx, y + dy, 7);
        let jitter = Vec2::new((word & 0xffff) as f32, (word >> 16) as f32) / 65536.0;
        let distance = (floor + Vec2::new(dx as f32, dy as f32) + 0.1 + 0.8 * jitter - p).length();
        if distance < nearest {
            (second, nearest, cell) = (nearest, distance, word);
        } else {
            second = second.min(distance);
        }
    }
    (second - nearest, cell)
}
