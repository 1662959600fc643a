/// Overwrites each view's first token in `x [views, tokens, width]` by `cameras [views, width]`.
pub fn insert_camera_tokens(x: &mut [f64], tokens: usize, cameras: &[f64], width: usize) {
    for (view, camera) in x.chunks_mut(tokens * width).zip(cameras.chunks(width)) {
        view[..width].copy_from_slice(camera);
    }
}

/// Assigns learned tokens `[2, width]` (reference, others) to views.
pub fn learned_camera_tokens(learned: &[f64], width: usize, views: usize, reference: usize) -> Vec<f64> {
    let (of_reference, of_others) = learned.split_at(width);
    (0..views).flat_map(|view| if view == reference { of_reference } else { of_others }).copied().collect()
}
