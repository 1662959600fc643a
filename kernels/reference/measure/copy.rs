pub fn copy(source: &[u32]) -> Vec<u32> {
    source.to_vec()
}
