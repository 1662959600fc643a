/// Resamples `embed [1 + side * side, width]`, class row first, to `[1 + rows * columns, width]`.
/// Bicubic (Keys 1981, A = -0.75), clamped, without antialiasing, scale `(patches + 0.1) / side`.
/// An equal grid is copied.
pub fn interpolate(embed: &[f64], width: usize, rows: usize, columns: usize) -> Vec<f64> {
    resample(embed, width, [rows, columns], taps)
}

/// [`interpolate`] with antialiasing, A = -0.5, scale `patches / side` and weights that sum to 1.
pub fn interpolate_antialiased(embed: &[f64], width: usize, rows: usize, columns: usize) -> Vec<f64> {
    resample(embed, width, [rows, columns], antialiased_taps)
}

type Taps = Vec<Vec<(usize, f64)>>;

fn resample(embed: &[f64], width: usize, [rows, columns]: [usize; 2], taps: fn(usize, usize) -> Taps) -> Vec<f64> {
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

/// Inputs within two scaled steps of the source, and their normalized weights.
fn antialiased_taps(outputs: usize, inputs: usize) -> Taps {
    let scale = inputs as f64 / outputs as f64;
    let spread = scale.max(1.0);
    let tap = |output: usize| {
        let source = scale * (output as f64 + 0.5);
        let bound = |at: f64| (at + 0.5).max(0.0) as usize;
        let inside = bound(source - 2.0 * spread)..bound(source + 2.0 * spread).min(inputs);
        let weights: Vec<f64> = inside.clone().map(|j| cubic((j as f64 - source + 0.5) / spread, -0.5)).collect();
        let total: f64 = weights.iter().sum();
        inside.zip(weights).map(|(place, weight)| (place, weight / total)).collect()
    };
    (0..outputs).map(tap).collect()
}

fn taps(outputs: usize, inputs: usize) -> Taps {
    let scale = (outputs as f64 + 0.1) / inputs as f64;
    let tap = |output: usize| {
        let source = (output as f64 + 0.5) / scale - 0.5;
        let first = source.floor() - 1.0;
        let tap = |step: f64| {
            let place = first + step;
            (place.clamp(0.0, (inputs - 1) as f64) as usize, cubic(source - place, -0.75))
        };
        [0.0, 1.0, 2.0, 3.0].map(tap).into()
    };
    (0..outputs).map(tap).collect()
}

fn cubic(d: f64, a: f64) -> f64 {
    let d = d.abs();
    match d {
        ..1.0 => (a + 2.0) * d.powi(3) - (a + 3.0) * d.powi(2) + 1.0,
        ..2.0 => a * (d.powi(3) - 5.0 * d.powi(2) + 8.0 * d - 4.0),
        _ => 0.0,
    }
}
