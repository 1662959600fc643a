/// Joins `[rows, left_width]` and `[rows, right_width]`.
pub fn join_columns(left: &[f64], left_width: usize, right: &[f64], right_width: usize) -> Vec<f64> {
    let rows = left.chunks(left_width).zip(right.chunks(right_width));
    rows.flat_map(|(left, right)| left.iter().chain(right)).copied().collect()
}

pub fn columns(rows: &[f64], width: usize, start: usize, end: usize) -> Vec<f64> {
    rows.chunks(width).flat_map(|row| &row[start..end]).copied().collect()
}
