/// Steps the largest scale down to `ratio` times the middle one, its logarithm by at most `rate`.
pub fn limited(scales: [f64; 3], ratio: f64, rate: f64) -> [f64; 3] {
    let mut sorted = scales;
    sorted.sort_by(f64::total_cmp);
    let [_, middle, largest] = sorted;
    let limit = (ratio * middle).max(largest * (-rate).exp());
    scales.map(|scale| scale.min(limit))
}
