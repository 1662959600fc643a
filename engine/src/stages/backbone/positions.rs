//! Position embeddings and rotary tables, on the host in f64.

/// Angle of channel pair j of h: position * BASE^(-2j / h).
const BASE: f64 = 100.0;

/// Sources and weights per target of a side's positions.
pub(super) type Taps = Vec<Vec<(usize, f64)>>;

/// Interpolates learned positions `[1 + side * side, width]` to `[1 + rows * columns, width]` by
/// `taps(side, targets)`; the class token and the original grid are unchanged.
pub(super) fn interpolate(
    learned: &[f32],
    [side, width]: [usize; 2],
    [rows, columns]: [usize; 2],
    taps: fn(usize, usize) -> Taps,
) -> Vec<f32> {
    if [rows, columns] == [side; 2] {
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

/// Returns (cos, sin) tables: local `[1 + rows * columns, dim / 2, 2]`, global `[1, dim / 2, 2]`.
///
/// Local positions: the camera token at the origin, patches at (y + 1, x + 1). Global patches share
/// a position one step from the camera token: unrotated, with camera tokens at (-1, -1). Half the
/// pairs rotate with y, half with x.
pub fn rotary_tables(rows: usize, columns: usize, dim: usize) -> [Vec<f32>; 2] {
    [rotary_table(1, rows, columns, dim), rotations([-1.0; 2], dim).collect()]
}

/// Returns the (cos, sin) table of `leading` tokens at the origin and patches at (y + 1, x + 1).
pub(super) fn rotary_table(leading: usize, rows: usize, columns: usize, dim: usize) -> Vec<f32> {
    let patches = (0..rows * columns).map(|i| [i / columns + 1, i % columns + 1].map(|step| step as f64));
    std::iter::repeat_n([0.0; 2], leading).chain(patches).flat_map(|place| rotations(place, dim)).collect()
}

fn rotations(place: [f64; 2], dim: usize) -> impl Iterator<Item = f32> {
    let angle = move |i: usize| place[i / (dim / 4)] * BASE.powf(-2.0 * (i % (dim / 4)) as f64 / (dim / 2) as f64);
    (0..dim / 2).map(angle).flat_map(|angle| [angle.cos() as f32, angle.sin() as f32])
}
