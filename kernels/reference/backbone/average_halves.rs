//! The way around the layer that merges the two halves of a feature.

/// The mean of both halves of each row: `[rows, 2 width]` to `[rows, width]`.
pub fn average_halves(joined: &[f64], width: usize) -> Vec<f64> {
    let rows = joined.chunks(2 * width).map(|row| row.split_at(width));
    rows.flat_map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a + b) / 2.0)).collect()
}
