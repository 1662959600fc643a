pub fn targets(photos: &[u8]) -> Vec<f64> {
    photos.iter().map(|byte| f64::from(*byte) / 255.0).collect()
}
