//! 2D rotary position embedding (Su et al. 2021; base 100).

const BASE: f64 = 100.0;

/// Rotates `x [tokens, heads, head_dim]` by `positions [tokens]` (y, x): y the first half of the
/// channels, x the second, in pairs a quarter head apart.
pub fn rope(x: &[f64], positions: &[[f64; 2]], head_dim: usize) -> Vec<f64> {
    let heads = x.len() / positions.len() / head_dim;
    let [half, quarter] = [head_dim / 2, head_dim / 4];
    let rotated = x.chunks(head_dim).enumerate().flat_map(|(i, head)| {
        let position = positions[i / heads];
        (0..head_dim).map(move |channel| {
            let [axis, within] = [channel / half, channel % half];
            let frequency = BASE.powf(-2.0 * (within % quarter) as f64 / half as f64);
            let (sin, cos) = (position[axis] * frequency).sin_cos();
            if within < quarter {
                head[channel] * cos - head[channel + quarter] * sin
            } else {
                head[channel] * cos + head[channel - quarter] * sin
            }
        })
    });
    rotated.collect()
}

/// Returns (0, 0) for the camera token, then (row, column) from 1.
pub fn local_positions(rows: usize, columns: usize) -> Vec<[f64; 2]> {
    let patches = (0..rows * columns).map(|place| [(place / columns + 1) as f64, (place % columns + 1) as f64]);
    [[0.0, 0.0]].into_iter().chain(patches).collect()
}

/// Returns (0, 0) for the camera token, (1, 1) for patches.
pub fn global_positions(rows: usize, columns: usize) -> Vec<[f64; 2]> {
    let mut positions = vec![[1.0, 1.0]; 1 + rows * columns];
    positions[0] = [0.0, 0.0];
    positions
}
