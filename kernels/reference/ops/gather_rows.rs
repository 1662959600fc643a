pub fn gather_rows(rows: &[f64], width: usize, indices: &[u32]) -> Vec<f64> {
    indices.iter().flat_map(|&i| &rows[i as usize * width..][..width]).copied().collect()
}
