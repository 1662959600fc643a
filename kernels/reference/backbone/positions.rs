//! Position embedding on another grid.

/// Resamples `embed [1 + side * side, width]`, class row first, to `[1 + rows * columns, width]`.
/// Bicubic (Keys 1981, A = -0.75), clamped, without antialiasing, scale `(patches + 0.1) / side`.
/// An equal grid is copied.
pub fn interpolate(embed: &[f64], width: usize, rows: usize, columns: usize) -> Vec<f64> {
    let side = (embed.len() / width - 1).isqrt();
    if [rows, columns] == [side, side] {
        return embed.to_vec();
    }
    let (class, grid) = embed.split_at(width);
    let [row_taps, column_taps] = [taps(rows, side), taps(columns, side)];
    let mut resampled = class.to_vec();
    for row in &row_taps {
        for column in &column_taps {
            resampled.extend((0..width).map(|channel| {
                let products =
                    row.iter().flat_map(|&(y, wy)| column.iter().map(move |&(x, wx)| (y * side + x, wy * wx)));
                products.map(|(place, weight)| weight * grid[place * width + channel]).sum::<f64>()
            }));
        }
    }
    resampled
}

/// Four inputs and weights per output.
fn taps(outputs: usize, inputs: usize) -> Vec<[(usize, f64); 4]> {
    let scale = (outputs as f64 + 0.1) / inputs as f64;
    let tap = |output: usize| {
        let source = (output as f64 + 0.5) / scale - 0.5;
        let first = source.floor() - 1.0;
        [0.0, 1.0, 2.0, 3.0].map(|step| {
            let place = first + step;
            (place.clamp(0.0, (inputs - 1) as f64) as usize, cubic(source - place))
        })
    };
    (0..outputs).map(tap).collect()
}

fn cubic(d: f64) -> f64 {
    const A: f64 = -0.75;
    let d = d.abs();
    match d {
        ..1.0 => (A + 2.0) * d.powi(3) - (A + 3.0) * d.powi(2) + 1.0,
        ..2.0 => A * (d.powi(3) - 5.0 * d.powi(2) + 8.0 * d - 4.0),
        _ => 0.0,
    }
}
