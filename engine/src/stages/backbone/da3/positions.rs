//! Position embeddings and rotary tables, on the host in f64.

/// Bicubic parameter of the reference.
const A: f64 = -0.75;

const OFFSET: f64 = 0.1;

/// Angle of channel pair j of h: position * BASE^(-2j / h).
const BASE: f64 = 100.0;

/// Interpolates learned positions `[1 + side * side, width]` to `[1 + rows * columns, width]`.
///
/// Bicubic with repeated edges; the class token and the original grid are unchanged.
pub fn interpolate(learned: &[f32], side: usize, width: usize, rows: usize, columns: usize) -> Vec<f32> {
    if (rows, columns) == (side, side) {
        return learned.to_vec();
    }
    let (ys, xs) = (taps(side, rows), taps(side, columns));
    let mut out = learned[..width].to_vec();
    out.reserve(rows * columns * width);
    let mut sum = vec![0.0f64; width];
    for y in &ys {
        for x in &xs {
            sum.fill(0.0);
            for (row, wy) in y {
                for (column, wx) in x {
                    let from = (1 + row * side + column) * width;
                    for (s, v) in sum.iter_mut().zip(&learned[from..from + width]) {
                        *s += wy * wx * *v as f64;
                    }
                }
            }
            out.extend(sum.iter().map(|s| *s as f32));
        }
    }
    out
}

fn taps(side: usize, count: usize) -> Vec<[(usize, f64); 4]> {
    let scale = (count as f64 + OFFSET) / side as f64;
    let near = |u: f64| ((A + 2.0) * u - (A + 3.0)) * u * u + 1.0;
    let far = |u: f64| ((A * u - 5.0 * A) * u + 8.0 * A) * u - 4.0 * A;
    let one = |i: usize| {
        let source = (i as f64 + 0.5) / scale - 0.5;
        let t = source - source.floor();
        let weights = [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)];
        let index = |k: usize| (source.floor() as i64 - 1 + k as i64).clamp(0, side as i64 - 1) as usize;
        [0, 1, 2, 3].map(|k| (index(k), weights[k]))
    };
    (0..count).map(one).collect()
}

/// Returns (cos, sin) tables: local `[1 + rows * columns, dim / 2, 2]`, global `[1, dim / 2, 2]`.
///
/// Local positions: the camera token at the origin, patches at (y + 1, x + 1). Global patches share
/// a position one step from the camera token; only differences matter, so patches stay unrotated
/// and camera tokens are at (-1, -1). Half the pairs rotate with y, half with x.
pub fn rotary_tables(rows: usize, columns: usize, dim: usize) -> [Vec<f32>; 2] {
    let patches = (0..rows * columns).map(|i| [i / columns + 1, i % columns + 1].map(|step| step as f64));
    let local = [[0.0; 2]].into_iter().chain(patches).flat_map(|place| rotations(place, dim)).collect();
    [local, rotations([-1.0; 2], dim).collect()]
}

fn rotations(place: [f64; 2], dim: usize) -> impl Iterator<Item = f32> {
    let angle = move |i: usize| place[i / (dim / 4)] * BASE.powf(-2.0 * (i % (dim / 4)) as f64 / (dim / 2) as f64);
    (0..dim / 2).map(angle).flat_map(|angle| [angle.cos() as f32, angle.sin() as f32])
}
