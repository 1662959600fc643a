/// Transposes `rows [N, width]` to `[panels, width, columns]`, padded with the last row.
pub fn panels(rows: &[f32], width: usize, columns: usize) -> Vec<f32> {
    let last = rows.len() / width - 1;
    let panel = |p: usize| (0..width).flat_map(move |c| (p * columns..(p + 1) * columns).map(move |row| (row, c)));
    (0..=last / columns).flat_map(panel).map(|(row, c)| rows[row.min(last) * width + c]).collect()
}
