/// Sums `x * factor + term`, iterated `steps` times from each start.
pub fn chains(starts: impl IntoIterator<Item = f64>, steps: u64, factor: f64, term: f64) -> f64 {
    starts.into_iter().map(|start| (0..steps).fold(start, |x, _| x * factor + term)).sum()
}
